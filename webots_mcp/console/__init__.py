"""Following the console of a Webots that runs: what it says becomes rows of the recording."""
