"""Stage 1, what can be run: application definitions, inventory, registry and access domains.

People write these files in the state repo; :func:`demandops.config.load.load` parses them all
and reports every fault of every file together. Knows nothing of demands.
"""
