"""Charts in the state repo: their files, libraries, values, schemas and tables."""
