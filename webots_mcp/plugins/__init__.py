"""What is built on the core, each in a package of this folder: page, report, pools, formats, demo.

A plugin may import everything; nothing imports a plugin by its name. `extras.plugins` finds the
packages of this folder and what each offers in `PLUGIN` of its `__init__`.
"""
