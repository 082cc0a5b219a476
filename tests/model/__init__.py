"""Independent models of the bookkeeping; the tests compare the program with them."""
