"""The server's side of the database: models, migrations, queries and the command queue."""
