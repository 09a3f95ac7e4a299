"""Speed beside error: every method gets the same inputs, in turn, in one process. Not run by default; see `make bench`."""
