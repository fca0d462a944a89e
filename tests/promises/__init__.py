"""What the pages promise, and what shows each promise: `promises.toml`, beside this file."""
