"""Every parser of foreign files, with valid examples to start from. A new parser is one line of one of these files."""

from tests.robustness.parsers import cdr, corpora, homes, maps, recordings, results, runs, scans, units
from tests.robustness.parsers.parser import Parser as Parser

PARSERS = [
    *runs.PARSERS,
    *corpora.PARSERS,
    *units.PARSERS,
    *recordings.PARSERS,
    *cdr.PARSERS,
    *maps.PARSERS,
    *results.PARSERS,
    *homes.PARSERS,
    *scans.PARSERS,
]
