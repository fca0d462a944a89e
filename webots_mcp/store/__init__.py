"""The server's side of the database: models, queries and the command queue."""
