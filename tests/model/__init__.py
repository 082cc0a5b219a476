"""An independent model of the bookkeeping, to hold the program against."""
