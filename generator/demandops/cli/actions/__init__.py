"""Commands that change the books: request, decommission, roll back."""
