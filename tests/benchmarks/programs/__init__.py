"""What has to run in a process of its own."""
