"""Plugins, which are built on the core: page, report, pool, cluster, formats, demo and prove.

A plugin may import everything; nothing else imports a plugin by its name. `extras.plugin_registry`
finds the packages of this folder, and what each offers in `PLUGIN` of its `__init__`.
"""
