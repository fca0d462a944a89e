"""The views of a pool in PostgreSQL: those of a recording, by the same names, with the recording.

The rule by which robot_now and robot_trajectory find a position and a mode in a state is the one of
`webots_mcp/naming.py`, and made of its words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from webots_mcp import naming
from webots_mcp.naming import METRES, metres_in
from webots_mcp.plugins.pool.postgres.connecting import Connection
from webots_mcp.schema import shipped_objects

_HUMP: Final = "(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])"  # where a word begins inside one


def _array(words: Iterable[str]) -> str:
    """Words as an array of texts."""
    return f"'{{{', '.join(words)}}}'::text[]"


def _path(name: str) -> str:
    """A dotted name as the path of a value in JSON."""
    return _array(name.split("."))


_USUAL_POSITIONS: Final = ",\n      ".join(
    f"({_path(x)}, {_path(y)}, {metres_in(x)})" for x, y in naming.USUAL_POSITIONS
)
_UNITS: Final = ", ".join(f"('{unit}', {metres})" for unit, metres in METRES.items())
_YAWS: Final = ", ".join(
    f"nullif(state #> {_path(name)}, 'null')"
    for name in ("pose.yaw", "pose.theta", "pose.heading", "yaw", "theta", "heading")
)
_SPELLINGS: Final = _array(sorted(naming.SPELLINGS))
_RANKED: Final = (*naming.MODES, *naming.STATES)

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

CREATE OR REPLACE FUNCTION words_of(part text) RETURNS text[]
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  SELECT string_to_array(lower(regexp_replace(part, '{_HUMP}', '_', 'g')), '_') $$;

-- What one of the unit in a name is in metres: the last counts, and a lone m only at an end.
CREATE OR REPLACE FUNCTION metres_of(parts text[]) RETURNS double precision
LANGUAGE plpgsql IMMUTABLE PARALLEL SAFE SET search_path FROM CURRENT AS $$
BEGIN
  RETURN coalesce((
    SELECT u.metres FROM unnest(parts) WITH ORDINALITY p (part, place),
      unnest(words_of(part)) WITH ORDINALITY w (word, at)
    JOIN (VALUES {_UNITS}) u (unit, metres) ON u.unit = word
    WHERE word <> 'm' OR lower(part) LIKE '%\_m'
    ORDER BY place DESC, at DESC LIMIT 1), 1);
END $$;

-- Numbers and texts of a state with their paths; of arrays only what can be a coordinate.
CREATE OR REPLACE FUNCTION leaves_of(state jsonb) RETURNS TABLE (path text[], value jsonb)
LANGUAGE sql IMMUTABLE PARALLEL SAFE AS $$
  WITH RECURSIVE node (path, value) AS (
    SELECT ARRAY[]::text[], state
    UNION ALL
    SELECT n.path || e.key, e.value FROM node n CROSS JOIN LATERAL (
      SELECT o.key, o.value
      FROM jsonb_each(CASE jsonb_typeof(n.value) WHEN 'object' THEN n.value ELSE '{{}}' END) o
      UNION ALL
      SELECT (a.ordinality - 1)::text, a.value FROM jsonb_array_elements(
        CASE jsonb_typeof(n.value) WHEN 'array' THEN n.value ELSE '[]' END
      ) WITH ORDINALITY a
      WHERE a.ordinality <= 2 OR jsonb_typeof(a.value) IN ('object', 'array')
    ) e)
  SELECT path, value FROM node WHERE jsonb_typeof(value) IN ('number', 'string') $$;

-- x and y of a state in metres: the first usual pair, else the first branch that has one.
CREATE OR REPLACE FUNCTION position_of(state jsonb) RETURNS double precision[]
LANGUAGE plpgsql IMMUTABLE PARALLEL SAFE SET search_path FROM CURRENT AS $$
DECLARE
  found double precision[];
BEGIN
  IF jsonb_typeof(state) IS DISTINCT FROM 'object' THEN
    RETURN NULL;
  END IF;
  SELECT ARRAY[number_of(state #> p.x) * p.metres, number_of(state #> p.y) * p.metres] INTO found
  FROM (VALUES
      {_USUAL_POSITIONS}
    ) p (x, y, metres)
  WHERE jsonb_typeof(state #> p.x) = 'number' AND jsonb_typeof(state #> p.y) = 'number' LIMIT 1;
  IF found IS NOT NULL THEN
    RETURN found;
  END IF;
  WITH leaf AS (
    SELECT path[:cardinality(path) - 1] AS branch, path[cardinality(path)] AS last, value,
      array_to_string(path, '.') AS name
    FROM leaves_of(state)
    WHERE jsonb_typeof(value) = 'number' AND (path[cardinality(path)] ~ '[xXyY]'
      OR path[cardinality(path)] IN ('0', '1')
        AND path[cardinality(path) - 1] ~* '{"|".join(naming.BRANCHES)}')
  ), worded AS (
    SELECT *, words_of(last) AS words, words_of(branch[cardinality(branch)]) AS beside,
      ARRAY(SELECT w FROM unnest(branch) part, unnest(words_of(part)) w) AS way
    FROM leaf
  ), place AS (
    SELECT *,
      CASE last WHEN '0' THEN 'x' WHEN '1' THEN 'y'
        ELSE (SELECT min(w) FROM unnest(words) w WHERE w IN ('x', 'y')) END AS axis,
      CASE WHEN last IN ('0', '1') THEN ARRAY[]::text[]
        ELSE ARRAY(SELECT w FROM unnest(words) w WHERE w NOT IN ('x', 'y')) END AS rest
    FROM worded WHERE NOT way && {_array(sorted(naming.ELSEWHERE))}
  ), own AS (
    SELECT * FROM place WHERE CASE WHEN last IN ('0', '1') THEN beside && {_array(naming.BRANCHES)}
      ELSE cardinality(rest) = cardinality(words) - 1 AND rest <@ {_array(sorted(naming.OWN))}
        AND cardinality(branch || rest) > 0 END
  )
  SELECT ARRAY[number_of(x.value) * x.metres, number_of(y.value) * x.metres] INTO found
  FROM (SELECT *, metres_of(branch || last) AS metres FROM own WHERE axis = 'x') x
  JOIN own y ON y.axis = 'y' AND y.branch = x.branch AND y.rest = x.rest
  ORDER BY NOT (coalesce(x.beside, '{{}}') || x.words) && {_array(naming.BRANCHES)},
    x.name COLLATE "C", y.name COLLATE "C" LIMIT 1;
  RETURN found;
END $$;

CREATE OR REPLACE FUNCTION yaw_of(state jsonb) RETURNS double precision
LANGUAGE sql IMMUTABLE PARALLEL SAFE SET search_path FROM CURRENT AS $$
  SELECT number_of(CASE
      CASE jsonb_typeof(state -> 'pose') WHEN 'array' THEN jsonb_array_length(state -> 'pose') END
    WHEN 3 THEN state #> '{{pose,2}}' WHEN 4 THEN state #> '{{pose,3}}'
    WHEN 6 THEN state #> '{{pose,5}}'
    ELSE coalesce({_YAWS}) END) $$;

-- What a robot is doing: the first text, or else whole number, at the name of a mode.
CREATE OR REPLACE FUNCTION mode_of(state jsonb) RETURNS text
LANGUAGE plpgsql IMMUTABLE PARALLEL SAFE SET search_path FROM CURRENT AS $$
DECLARE
  found text;
BEGIN
  IF jsonb_typeof(state) IS DISTINCT FROM 'object' THEN
    RETURN NULL;
  END IF;
  SELECT state ->> word INTO found FROM unnest({_array(naming.MODES)}) word
  WHERE jsonb_typeof(state -> word) = 'string' LIMIT 1;
  IF found IS NOT NULL THEN
    RETURN found;
  END IF;
  SELECT text_of(named.value) INTO found FROM (
    SELECT value, array_to_string(path, '.') AS name, jsonb_typeof(value) = 'number' AS is_number,
      CASE WHEN cardinality(words) > 1 AND words[cardinality(words)] = ANY({_SPELLINGS})
        THEN words[:cardinality(words) - 1] ELSE words END AS words
    FROM leaves_of(state),
      words_of(regexp_replace(path[cardinality(path)], '^.*[.]', '')) words
    WHERE jsonb_typeof(value) = 'string' OR scale(value::numeric) = 0
  ) named, array_position({_array(_RANKED)}, words[cardinality(words)]) rank
  WHERE rank IS NOT NULL AND NOT words && {_array(sorted(naming.PAST_OR_FUTURE))}
  ORDER BY is_number, rank > {len(naming.MODES)},
    CASE WHEN name = array_to_string(words, '_') AND cardinality(words) = 1 THEN rank
      ELSE {len(_RANKED) + 1} END, length(name), name COLLATE "C"
  LIMIT 1;
  RETURN found;
END $$;
"""

_KEY: Final = "recording_uuid"
_NOW_S: Final = "extract(epoch FROM clock_timestamp())::double precision"


def _robot_of(alias: str) -> str:
    return f"""(SELECT r.name FROM run u JOIN robot r USING ({_KEY})
    WHERE u.{_KEY} = {alias}.{_KEY} AND u.id = {alias}.run_id AND r.id = u.robot_id) AS robot"""


_POSE: Final = """
  p.xy[1] AS x_m, p.xy[2] AS y_m, yaw_of(s.data) AS yaw_rad, mode_of(s.data) AS mode"""
# With an OFFSET it is found once for both coordinates, and not at all where none is asked for.
_POSITION: Final = "CROSS JOIN LATERAL (SELECT position_of(s.data) AS xy OFFSET 0) p"

# In the order in which they are made: what a view asks comes before it.
_QUERIES: Final = {
    "every_state": f"""SELECT {_KEY}, id AS state_id, run_id, sim_time_s, wall_time_s, data, odd
FROM state
UNION ALL
SELECT {_KEY}, NULL, run_id, sim_time_s, wall_time_s, data, odd FROM kept_state""",
    "all_rollup": "SELECT * FROM rollup",
    "robot_now": f"""SELECT r.{_KEY}, r.name AS robot, u.id AS run_id, u.end_reason, s.sim_time_s,
  rounded({_NOW_S} - s.wall_time_s, 1) AS age_s,{_POSE},
  s.data, s.odd
FROM robot r
LEFT JOIN LATERAL (SELECT id, end_reason FROM run
  WHERE {_KEY} = r.{_KEY} AND robot_id = r.id ORDER BY id DESC LIMIT 1) u ON true
LEFT JOIN LATERAL (SELECT sim_time_s, wall_time_s, data, odd FROM state
  WHERE {_KEY} = r.{_KEY} AND run_id = u.id ORDER BY sim_time_s DESC, id DESC LIMIT 1) s ON true
{_POSITION}""",
    "robot_trajectory": f"""SELECT s.{_KEY}, {_robot_of("s")},
  s.run_id, s.id AS state_id, s.sim_time_s, utc_text(s.wall_time_s) AS utc,{_POSE}, s.odd
FROM state s {_POSITION}""",
    "robot_run": f"""SELECT u.{_KEY}, r.name AS robot, u.id AS run_id, u.label,
  utc_text(u.started_wall_time_s) AS started_utc,
  rounded(u.last_sim_time_s - u.started_sim_time_s, 3) AS duration_s,
  rounded(u.last_wall_time_s - u.started_wall_time_s, 3) AS wall_duration_s,
  rounded((u.last_sim_time_s - u.started_sim_time_s)
    / nullif(u.last_wall_time_s - u.started_wall_time_s, 0), 3) AS real_time_factor,
  u.rows, u.purged_rows,
  rounded(u.rows / nullif(u.last_sim_time_s - u.started_sim_time_s, 0), 2) AS rows_per_s,
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
    "robot_kept": f"""SELECT k.{_KEY}, r.name AS robot, k.run_id, k.id AS stretch_id,
  k.start_sim_time_s AS start_s,
  least(k.end_sim_time_s, greatest(u.last_sim_time_s, k.start_sim_time_s)) AS end_s,
  (SELECT count(*) FROM every_state s WHERE s.{_KEY} = k.{_KEY} AND s.run_id = k.run_id
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
