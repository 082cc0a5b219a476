"""What people see of a state, as rows and values."""
