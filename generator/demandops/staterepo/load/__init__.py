"""Loading a commit: its configuration and ledger, and last valid versions of invalid files.

If people commit an invalid file, ``last_valid_config`` decides which configuration stays in effect,
``ledger_files`` which claims. ``state_in_effect`` decides about valid files that cannot be planned.
"""
