"""Commands for a state repo as a whole, for its files, and for the program itself."""
