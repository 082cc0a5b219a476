"""Loading a commit: its configuration and ledger, with the last valid versions of invalid files.

If people commit an invalid file, ``last_valid_config`` decides which configuration stays in effect,
and ``ledger_files`` decides which claims stay in effect. ``state_in_effect`` decides about files
that are valid, but cannot be planned.
"""
