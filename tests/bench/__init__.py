"""Speed beside error: every method gets the same inputs, in turn, in one process. See `make bench`."""
