"""The views of a pool in PostgreSQL: those of a recording, by the same names, with its UUID."""

from __future__ import annotations

import re
from typing import Final

from webots_mcp.connection import shipped_objects
from webots_mcp.naming import METRES
from webots_mcp.plugins.pool.postgres.connecting import Connection

# From the first Julian day to 1970: SQLite adds it before it rounds, and so loses some digits.
_JULIAN_MS: Final = "210866760000000.0::double precision"

# Functions are found by name when a view is asked: so they keep the search path they were made in.
_FUNCTIONS: Final = rf"""
CREATE OR REPLACE FUNCTION utc_text(wall_time_s double precision) RETURNS text
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT CASE WHEN wall_time_s BETWEEN -62135596800 AND 253402300799
    THEN to_char(timestamp '1970-01-01' + interval '1 ms' * (
      floor(wall_time_s * 1000 + {_JULIAN_MS} + 0.5) - {_JULIAN_MS}), 'YYYY-MM-DD HH24:MI:SS.MS')
    END $$;

CREATE OR REPLACE FUNCTION rounded(number double precision, digits integer)
RETURNS double precision LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT round(number::numeric, digits)::double precision $$;

-- A JSON value as SQLite's json_extract gives it: true and false are 1 and 0.
CREATE OR REPLACE FUNCTION text_of(value jsonb) RETURNS text
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT CASE jsonb_typeof(value) WHEN 'boolean' THEN CASE WHEN value::boolean THEN '1' ELSE '0' END
    ELSE value #>> '{{}}' END $$;

-- JSON has numbers that are beyond all floats.
CREATE OR REPLACE FUNCTION number_of(value jsonb) RETURNS double precision
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT CASE WHEN jsonb_typeof(value) <> 'number' THEN NULL
    WHEN abs(value::numeric) > 1.7e308 THEN sign(value::numeric) * 'Infinity'::double precision
    WHEN abs(value::numeric) < 1e-307 THEN 0
    ELSE value::double precision END $$;

CREATE OR REPLACE FUNCTION value_at(state jsonb, path text) RETURNS jsonb
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT jsonb_path_query_first(state, ('strict ' || path)::jsonpath, '{{}}', true) $$;
"""

_KEY: Final = "recording_uuid"
_VALUE: Final = "value_at(s.data, p.path)"
_NUMBER: Final = f"number_of({_VALUE})"
_IS_NUMBER: Final = f"jsonb_typeof({_VALUE}) = 'number'"
_NOW_S: Final = "extract(epoch FROM clock_timestamp())::double precision"


def _robot_of(alias: str) -> str:
    return f"""(SELECT r.name FROM run u JOIN robot r USING ({_KEY})
    WHERE u.{_KEY} = {alias}.{_KEY} AND u.id = {alias}.run_id AND r.id = u.robot_id) AS robot"""


def _motion(robot_id: str) -> str:
    """What the signals with a role have in a row `s`."""
    metres = " ".join(f"WHEN '{unit}' THEN {metres}" for unit, metres in METRES.items())
    integer = f"jsonb_typeof({_VALUE}) = 'number' AND scale(({_VALUE})::numeric) = 0"
    shown = {
        "x_m": _first(robot_id, "x", f"{_NUMBER} * CASE p.unit {metres} ELSE 1 END", beside="y"),
        "y_m": _first(robot_id, "y", f"{_NUMBER} * CASE p.unit {metres} ELSE 1 END", beside="x"),
        "yaw_rad": _first(
            robot_id, "yaw", f"{_NUMBER} * CASE p.unit WHEN 'deg' THEN pi() / 180 ELSE 1 END"
        ),
        "mode": _first(
            robot_id,
            "mode",
            f"text_of({_VALUE})",
            f"jsonb_typeof({_VALUE}) = 'string' OR {integer}",
        ),
        "speed": _first(robot_id, "speed"),
        "commanded_speed": _first(robot_id, "commanded_speed"),
    }
    return ",".join(f"\n  {query} AS {name}" for name, query in shown.items())


def _first(
    robot_id: str, role: str, shown: str = _NUMBER, wanted: str = _IS_NUMBER, beside: str = ""
) -> str:
    """The first of these roles that has such a value in the row, beside one of another role."""
    other = (
        f"JOIN signal o ON o.{_KEY} = p.{_KEY} AND o.robot_id = p.robot_id "
        f"AND o.role = '{beside}' || substr(p.role, 2) AND {_IS_NUMBER.replace('p.', 'o.')}"
    )
    # With an OFFSET they are chosen first: a path without a role may be none for PostgreSQL.
    return f"""(SELECT {shown} FROM (SELECT * FROM signal WHERE {_KEY} = s.{_KEY}
      AND robot_id = {robot_id} AND role COLLATE "C" BETWEEN '{role}' AND '{role}9' OFFSET 0) p
    {other if beside else ""}
    WHERE {wanted} ORDER BY p.role COLLATE "C" LIMIT 1)"""


# In the order in which they are made: what a view asks comes before it.
_QUERIES: Final = {
    "all_state": f"""SELECT {_KEY}, id AS state_id, run_id, sim_time_s, wall_time_s, data, replaced
FROM state
UNION ALL
SELECT {_KEY}, NULL, run_id, sim_time_s, wall_time_s, data, replaced FROM kept_state k
WHERE call IS NOT NULL OR NOT EXISTS (SELECT 1 FROM state s /* retention moved it there */
  WHERE s.{_KEY} = k.{_KEY} AND s.run_id = k.run_id AND s.sim_time_s = k.sim_time_s
    AND s.wall_time_s = k.wall_time_s)""",
    "robot_now": f"""SELECT r.{_KEY}, r.name AS robot, u.id AS run_id, u.end_reason, s.sim_time_s,
  rounded({_NOW_S} - s.wall_time_s, 1) AS age_s,{_motion("r.id")},
  s.data, s.replaced
FROM robot r
LEFT JOIN LATERAL (SELECT id, end_reason FROM run
  WHERE {_KEY} = r.{_KEY} AND robot_id = r.id ORDER BY id DESC LIMIT 1) u ON true
LEFT JOIN LATERAL (SELECT * FROM state
  WHERE {_KEY} = r.{_KEY} AND run_id = u.id ORDER BY sim_time_s DESC, id DESC LIMIT 1) s ON true""",
    "robot_trajectory": f"""SELECT s.{_KEY}, {_robot_of("s")},
  s.run_id, s.id AS state_id, s.sim_time_s, utc_text(s.wall_time_s) AS utc,{_motion("v.robot_id")},
  s.replaced
FROM state s LEFT JOIN run v ON v.{_KEY} = s.{_KEY} AND v.id = s.run_id""",
    "robot_run": f"""SELECT u.{_KEY}, r.name AS robot, u.id AS run_id, u.label,
  utc_text(u.started_wall_time_s) AS started_utc,
  rounded(u.last_sim_time_s - u.started_sim_time_s, 3) AS duration_s,
  rounded(u.last_wall_time_s - u.started_wall_time_s, 3) AS wall_duration_s,
  rounded((u.last_sim_time_s - u.started_sim_time_s)
    / nullif(u.last_wall_time_s - u.started_wall_time_s, 0), 3) AS real_time_factor,
  u.row_count, u.purged_rows,
  rounded(u.row_count / nullif(u.last_sim_time_s - u.started_sim_time_s, 0), 2) AS rows_per_s,
  u.start_reason, u.end_reason, u.keep, u.note, u.world, s.controller, s.controller_sha256,
  s.git_commit, u.session_id
FROM run u JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id
JOIN session s ON s.{_KEY} = u.{_KEY} AND s.id = u.session_id""",
    "robot_command": f"""SELECT c.{_KEY}, r.name AS robot, c.id AS command_id, c.action, c.params,
  c.status, utc_text(c.created_wall_time_s) AS created_utc,
  rounded(coalesce(c.claimed_wall_time_s, c.finished_wall_time_s, {_NOW_S})
    - c.created_wall_time_s, 3) AS waiting_s,
  rounded(coalesce(c.finished_wall_time_s, {_NOW_S}) - c.claimed_wall_time_s, 3) AS running_s,
  c.claimed_sim_time_s, c.finished_sim_time_s,
  CASE WHEN c.finished_sim_time_s >= c.claimed_sim_time_s /* a reset takes it back */
    THEN rounded(c.finished_sim_time_s - c.claimed_sim_time_s, 3) END AS running_sim_s,
  c.result, c.error, c.requested_by, c.session_id
FROM command c JOIN robot r ON r.{_KEY} = c.{_KEY} AND r.id = c.robot_id""",
    "robot_event": f"""SELECT e.{_KEY}, {_robot_of("e")},
  e.run_id, e.id AS event_id, e.sim_time_s, utc_text(e.wall_time_s) AS utc, e.kind, e.name,
  text_of(e.data -> 'from') AS from_value, text_of(e.data -> 'to') AS to_value, e.data
FROM event e""",
    "robot_log": f"""SELECT l.{_KEY}, {_robot_of("l")},
  l.run_id, l.id AS log_id, l.sim_time_s, utc_text(l.wall_time_s) AS utc, l.level, l.source,
  l.logger, l.message
FROM log l""",
    "robot_period": f"""SELECT p.{_KEY}, {_robot_of("p")},
  p.run_id, p.name AS signal, p.value, p.start_s,
  coalesce(p.next_s, u.last_sim_time_s) AS end_s,
  rounded(coalesce(p.next_s, u.last_sim_time_s) - p.start_s, 3) AS duration_s
FROM (
  SELECT {_KEY}, run_id, name, value, start_s,
    lead(start_s) OVER (PARTITION BY {_KEY}, run_id, name ORDER BY start_s, id, side) AS next_s
  FROM (
    SELECT e.{_KEY}, e.run_id, e.name, e.id, k.side,
      CASE k.side WHEN 0 THEN coalesce((SELECT min(f.sim_time_s) FROM state f
          WHERE f.{_KEY} = v.{_KEY} AND f.run_id = v.id AND f.sim_time_s <= e.sim_time_s
            AND v.purged_rows = 0), v.started_sim_time_s /* purged, or not shipped */)
        ELSE e.sim_time_s END AS start_s,
      text_of(e.data -> CASE k.side WHEN 0 THEN 'from' ELSE 'to' END) AS value
    FROM event e JOIN run v ON v.{_KEY} = e.{_KEY} AND v.id = e.run_id
    CROSS JOIN (VALUES (0), (1)) k (side)
    WHERE e.kind = 'change' AND (k.side = 1 OR NOT EXISTS (
      SELECT 1 FROM event b WHERE b.{_KEY} = e.{_KEY} AND b.run_id = e.run_id
        AND b.kind = 'change' AND b.name = e.name AND b.id < e.id))
  ) c
) p JOIN run u ON u.{_KEY} = p.{_KEY} AND u.id = p.run_id""",
    "robot_parameter": f"""SELECT v.{_KEY}, r.name AS robot, v.run_id, v.name,
  v.value #>> '{{}}' AS value, p.unit, v.sim_time_s AS since_s, utc_text(v.wall_time_s) AS utc,
  v.is_default, v.set_by, v.command_id
FROM parameter_value v JOIN run u ON u.{_KEY} = v.{_KEY} AND u.id = v.run_id
JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id
LEFT JOIN LATERAL (SELECT unit FROM parameter WHERE {_KEY} = u.{_KEY} AND robot_id = u.robot_id
  AND name = v.name ORDER BY id DESC LIMIT 1) p ON true""",
    "robot_statistics": f"""SELECT g.{_KEY}, r.name AS robot, g.run_id, s.name AS signal,
  g.start_sim_time_s AS start_s, g.end_sim_time_s AS end_s, c.row_count, c.value_count, c.min,
  c.max, c.sum / nullif(c.value_count, 0) AS mean, c.first, c.last, c.largest_step, c.change_count
FROM chunk c JOIN row_group g ON g.{_KEY} = c.{_KEY} AND g.id = c.group_id
JOIN signal s ON s.{_KEY} = c.{_KEY} AND s.id = c.signal_id
JOIN robot r ON r.{_KEY} = s.{_KEY} AND r.id = s.robot_id""",
    "robot_kept": f"""SELECT k.{_KEY}, r.name AS robot, k.run_id, k.id AS stretch_id,
  k.start_sim_time_s AS start_s,
  least(k.end_sim_time_s, greatest(u.last_sim_time_s, k.start_sim_time_s)) AS end_s,
  (SELECT count(*) FROM all_state s WHERE s.{_KEY} = k.{_KEY} AND s.run_id = k.run_id
    AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) AS states,
  utc_text(k.wall_time_s) AS utc, k.reason
FROM kept_stretch k JOIN run u ON u.{_KEY} = k.{_KEY} AND u.id = k.run_id
JOIN robot r ON r.{_KEY} = u.{_KEY} AND r.id = u.robot_id""",
}  # fmt: skip


def _described(name: str) -> str:
    """What the view of that name shows, as the schema of a recording says it."""
    said = re.search(r"/\* (.*?) \*/", shipped_objects()[name], re.DOTALL)
    assert said is not None, f"{name} has no comment"
    return said[1].replace("ask with run_id", f"ask with {_KEY} = ..., run_id")


# By their names: what is said of each view, and what it selects.
VIEWS: Final = {name: (_described(name), query) for name, query in _QUERIES.items()}


def make_views(connection: Connection) -> None:
    """Make the views, which are not there, and the functions that they ask."""
    connection.execute(_FUNCTIONS.encode())
    for name, (said, query) in VIEWS.items():
        connection.execute(f"CREATE VIEW {name} AS\n{query}".encode())
        connection.execute(
            f"COMMENT ON VIEW {name} IS '{said.replace(chr(39), chr(39) * 2)}'".encode()
        )
