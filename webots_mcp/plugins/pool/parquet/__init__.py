"""A pool as Parquet files, in a folder or on any filesystem that fsspec knows.

`layout` says in which file a row is, `rows` what a file holds, `storage` how a file comes to be
there as a whole. `writing` ships to it, `reading` and `asking` read it.
"""
