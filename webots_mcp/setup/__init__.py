"""What makes a project ready: client entries, edits of controllers and worlds, skills, doctor.

Only the command line, the question `webots_diagnose_setup` and plugins import it. It may look at
everything below: the simulator's project, the recording, the extras.
"""
