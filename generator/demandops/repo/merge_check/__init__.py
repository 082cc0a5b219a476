"""A pull request's files are checked and rendered before they are merged."""
