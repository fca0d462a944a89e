"""Files of Webots: the parser of worlds and PROTO files, where PROTO files are, and poses.

The stand-in and the search for faults of worlds import it. It uses the standard library only.
"""
