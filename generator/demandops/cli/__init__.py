"""The command line. It formats what the stages return and decides nothing."""
