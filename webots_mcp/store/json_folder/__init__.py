"""Importing the data folder of a bridge that writes JSON files, as one finished run.

    status.json            the newest state, one object, with an ISO `timestamp`
    logs/controller.log    lines "[HH:MM:SS] message"
    camera/*.png, screenshots/*.png
    commands.json          the newest command, if it was not taken

Such a folder has no simulation times: they are counted in seconds of wall time from the earliest
thing in it. `reading` checks everything before `import_folder` writes the first row.
"""

from webots_mcp.store.json_folder.folder_import import Imported, import_folder
from webots_mcp.store.json_folder.folder_reading import read_folder

__all__ = ["Imported", "import_folder", "read_folder"]
