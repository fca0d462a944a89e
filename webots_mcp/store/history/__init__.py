"""Questions about any stretch of recorded time; plain functions over an open connection.

    ranges     resolve_range: what a time range means; the argument of most others
    signals    list_signals: which names there are, and what is known of them
    series     query_history: columns of buckets, change points; pages: query_rows, row by row
    trends     trends: what each signal did, what changed most first
    events     find_events: stuck, gap, jump, ...; timeline: everything in order
    runs       list_runs, annotate_run; compare: compare_runs, compare_code
    sql        query_sql; schema_text: describe_schema
    rollup     roll: what the maintainer calls, so that long ranges answer in milliseconds

Standard library only. Answers are frozen dataclasses with full precision: rounding is the
caller's. Numbers of items are bounded by `limit` or `max_points`, and every answer says what it
left out. Every module says in its first lines what it holds.
"""
