"""Commands for a state repo as a whole: init, check, upgrade, verify, schema."""
