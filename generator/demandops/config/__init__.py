"""Stage 1, the configuration: application definitions, inventory, registry, policy, overrides.

People write these files in the state repo. :func:`demandops.config.load.load` parses all of them
and reports the faults of all files at once. This stage does not know demands.
"""
