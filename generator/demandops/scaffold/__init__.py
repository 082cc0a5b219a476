"""The files that ``demandops new`` writes for people to edit, valid from the start."""
