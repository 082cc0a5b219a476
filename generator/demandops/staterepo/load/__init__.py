"""Loading a commit: its configuration and ledger, and last valid versions of invalid files.

If people commit an invalid file, ``last_valid_config`` decides which configuration stays in effect,
and ``ledger_files`` which claims do. ``state_in_effect`` decides about valid files that cannot be
planned.
"""
