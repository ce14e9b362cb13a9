"""How fast each part is, beside a limit of the same machine measured in the same run: `make bench`."""
