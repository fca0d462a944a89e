"""What may be missing: packages of optional extras, and the plugins that are there.

Any folder may ask here before it imports an optional package. It imports the standard library only.
"""
