"""The audit: checks the signature of each commit, and the files that the commit changed."""
