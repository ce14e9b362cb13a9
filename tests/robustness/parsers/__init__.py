"""Parsers of untrusted files with valid examples. Add a parser as one line of one of these modules."""

from tests.robustness.parsers import cdr, homes, maps, recordings, results, runs, scans, shards, units
from tests.robustness.parsers.parser import Parser as Parser

PARSERS = [
    *runs.PARSERS,
    *shards.PARSERS,
    *units.PARSERS,
    *recordings.PARSERS,
    *cdr.PARSERS,
    *maps.PARSERS,
    *results.PARSERS,
    *homes.PARSERS,
    *scans.PARSERS,
]
