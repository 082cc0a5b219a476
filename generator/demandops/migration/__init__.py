"""The reference's applications and connections, turned into ordinary demands.

The reference keeps who demands what in files of its operators, and what runs in custom resources.
Neither has the ids of the demands. A map that a person checks supplies them.
"""
