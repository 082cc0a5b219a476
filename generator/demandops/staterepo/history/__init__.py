"""What commits say: their messages, their authors, and the history of a path."""
