"""Small faults of the package, each with the tests that notice it: see `__main__`."""
