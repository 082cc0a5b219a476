"""Commands for a state repo as a whole: init, check, journal, schema, upgrade, verify."""
