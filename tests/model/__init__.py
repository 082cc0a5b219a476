"""Independent models of the bookkeeping, with which the tests compare the program."""
