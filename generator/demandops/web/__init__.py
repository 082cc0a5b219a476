"""The web page, which shows the state repo live. It changes nothing."""
