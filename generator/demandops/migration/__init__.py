"""The reference's applications and connections, turned into ordinary demands.

The reference records who demands what in files of its operators, and what is deployed in custom
resources. Neither of them contains the ids of the demands. These ids come from a map that a person
checks.
"""
