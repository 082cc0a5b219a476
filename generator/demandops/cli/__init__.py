"""The command line: ``demandops``. Formats what the stages return; decides nothing."""
