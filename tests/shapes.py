"""The type checker of the annotated shapes, on while testing only (see `addopts` in pyproject.toml)."""

from beartype import BeartypeConf, beartype

#: An int is accepted where a float is asked for, as type checkers do.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
