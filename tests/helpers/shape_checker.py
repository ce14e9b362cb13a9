"""Runtime checker of shapes and types in the tests: beartype with int accepted as float (PEP 484)."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
