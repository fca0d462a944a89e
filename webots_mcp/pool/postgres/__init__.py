"""PostgreSQL as a pool: `schema` and `views` make it, `writing` fills it, `reading` asks it."""
