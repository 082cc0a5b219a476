"""Types of connection, one module each behind one interface."""
