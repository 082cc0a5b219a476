"""The content of each view of the page, as plain values: no HTTP, no HTML, no Git."""
