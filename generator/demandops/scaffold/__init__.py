"""The files that ``demandops new`` writes for people to edit. They are valid from the start."""
