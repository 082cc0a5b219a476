"""Which node an application gets, and when it moves."""
