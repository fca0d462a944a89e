"""Views for people in the `sqlite3` shell; runs that are kept, and what was purged of the others.

Every view begins with `robot_`; every row names the robot. A later migration that rebuilds a table
has to drop the views first and make them again after it.

Revision ID: 0003
Revises: 0002
"""

from alembic import op

revision = "0003"
down_revision = "0002"


def first_of(paths: str) -> str:
    """The first of these places in a state that holds something; null where it is no JSON."""
    found = ",\n    ".join(f"json_extract(j, '$.{path}')" for path in paths.split())
    return f"coalesce(\n    {found})"


# The usual ways to publish where a robot is: pose [x, y, yaw], [x, y, z, yaw] or
# [x, y, z, roll, pitch, yaw], else by name.
POSE = f"""
  {first_of("pose[0] pose.x position[0] position.x gps[0] gps.x x")} AS x_m,
  {first_of("pose[1] pose.y position[1] position.y gps[1] gps.y y")} AS y_m,
  CASE json_array_length(j, '$.pose')
    WHEN 3 THEN json_extract(j, '$.pose[2]')
    WHEN 4 THEN json_extract(j, '$.pose[3]')
    WHEN 6 THEN json_extract(j, '$.pose[5]')
    ELSE {first_of("pose.yaw pose.theta pose.heading yaw theta heading")}
  END AS yaw_rad,
  CASE WHEN json_type(j, '$.mode') = 'text' THEN json_extract(j, '$.mode')
    WHEN json_type(j, '$.state') = 'text' THEN json_extract(j, '$.state') END AS mode"""
ROBOT = """(
  SELECT r.name FROM run u JOIN robot r ON r.id = u.robot_id WHERE u.id = {}.run_id) AS robot"""
NOW_S = "(julianday('now') - 2440587.5) * 86400.0"


def utc(column: str) -> str:
    return f"strftime('%Y-%m-%d %H:%M:%f', {column}, 'unixepoch')"


ROBOT_NOW = f"""
CREATE VIEW robot_now AS
/* The newest state of each robot and how old it is. Lengths and angles as published. */
SELECT robot, run_id, end_reason, sim_time_s, round({NOW_S} - wall_time_s, 1) AS age_s,{POSE},
  data, odd
FROM (
  SELECT r.name AS robot, u.id AS run_id, s.sim_time_s, s.wall_time_s, s.data, s.odd,
    u.end_reason, CASE WHEN json_valid(s.data) THEN s.data END AS j
  FROM robot r
  LEFT JOIN run u ON u.id = (SELECT max(id) FROM run WHERE robot_id = r.id)
  LEFT JOIN state s ON s.id = (
    SELECT id FROM state WHERE run_id = u.id ORDER BY sim_time_s DESC, id DESC LIMIT 1)
)"""

ROBOT_TRAJECTORY = f"""
CREATE VIEW robot_trajectory AS
/* Where each robot was and in which mode, row by row: ask with run_id = ... and a time. */
SELECT {ROBOT.format("s")},
  s.run_id, s.id AS state_id, s.sim_time_s,
  {utc("s.wall_time_s")} AS utc,{POSE}, s.odd
FROM (SELECT *, CASE WHEN json_valid(data) THEN data END AS j FROM state) s"""

ROBOT_RUN = f"""
CREATE VIEW robot_run AS
/* Runs: how long in simulation and in wall time, how fast, what is left of the rows. */
SELECT r.name AS robot, u.id AS run_id, u.label, {utc("u.started_wall_time_s")} AS started_utc,
  round(u.last_sim_time_s - u.started_sim_time_s, 3) AS duration_s,
  round(u.last_wall_time_s - u.started_wall_time_s, 3) AS wall_duration_s,
  round((u.last_sim_time_s - u.started_sim_time_s)
    / nullif(u.last_wall_time_s - u.started_wall_time_s, 0), 3) AS real_time_factor,
  u.rows, u.purged_rows,
  round(u.rows / nullif(u.last_sim_time_s - u.started_sim_time_s, 0), 2) AS rows_per_s,
  u.start_reason, u.end_reason, u.keep, u.note, u.world, s.controller, s.controller_sha256,
  s.git_commit, u.session_id
FROM run u JOIN robot r ON r.id = u.robot_id JOIN session s ON s.id = u.session_id"""

ROBOT_COMMAND = f"""
CREATE VIEW robot_command AS
/* Commands: how long each waited to be claimed (or waits), and how long it ran (or runs). */
SELECT r.name AS robot, c.id AS command_id, c.action, c.params, c.status,
  {utc("c.created_wall_time_s")} AS created_utc,
  round(coalesce(c.claimed_wall_time_s, c.finished_wall_time_s, {NOW_S})
    - c.created_wall_time_s, 3) AS waiting_s,
  round(coalesce(c.finished_wall_time_s, {NOW_S}) - c.claimed_wall_time_s, 3) AS running_s,
  c.claimed_sim_time_s, c.finished_sim_time_s,
  CASE WHEN c.finished_sim_time_s >= c.claimed_sim_time_s /* a reset takes it back */
    THEN round(c.finished_sim_time_s - c.claimed_sim_time_s, 3) END AS running_sim_s,
  c.result, c.error, c.requested_by, c.session_id
FROM command c JOIN robot r ON r.id = c.robot_id"""

ROBOT_EVENT = f"""
CREATE VIEW robot_event AS
/* Events: what changed (name, from_value, to_value), resets, pauses, dropped rows. */
SELECT {ROBOT.format("e")},
  e.run_id, e.id AS event_id, e.sim_time_s,
  {utc("e.wall_time_s")} AS utc, e.kind, e.name,
  json_extract(j, '$.from') AS from_value, json_extract(j, '$.to') AS to_value, e.data
FROM (SELECT *, CASE WHEN json_valid(data) THEN data END AS j FROM event) e"""

ROBOT_LOG = f"""
CREATE VIEW robot_log AS
/* Log lines with their simulation time. */
SELECT {ROBOT.format("l")},
  l.run_id, l.id AS log_id, l.sim_time_s,
  {utc("l.wall_time_s")} AS utc, l.level, l.source, l.message
FROM log l"""

# From the events that the bridge writes at once, so that it needs no rollup. The value before a
# signal's first change held from the start of the run: that change counts twice, as side 0 and 1.
# Without UNION, on which DuckDB stumbles when it reads the views of a SQLite database.
ROBOT_PERIOD = f"""
CREATE VIEW robot_period AS
/* How long a text or flag of the state kept a value. Signals that never changed have none. */
SELECT {ROBOT.format("p")},
  p.run_id, p.name AS signal, p.value, p.start_s,
  coalesce(p.next_s, u.last_sim_time_s) AS end_s,
  round(coalesce(p.next_s, u.last_sim_time_s) - p.start_s, 3) AS duration_s
FROM (
  SELECT run_id, name, value, start_s,
    lead(start_s) OVER (PARTITION BY run_id, name ORDER BY start_s, id, side) AS next_s
  FROM (
    SELECT e.run_id, e.name, e.id, k.value AS side,
      CASE k.value WHEN 0 THEN v.started_sim_time_s ELSE e.sim_time_s END AS start_s,
      CASE WHEN json_valid(e.data)
        THEN json_extract(e.data, CASE k.value WHEN 0 THEN '$.from' ELSE '$.to' END) END AS value
    FROM event e JOIN run v ON v.id = e.run_id CROSS JOIN json_each('[0, 1]') k
    WHERE e.kind = 'change' AND (k.value = 1 OR NOT EXISTS (
      SELECT 1 FROM event b
      WHERE b.run_id = e.run_id AND b.kind = 'change' AND b.name = e.name AND b.id < e.id))
  ) c
) p JOIN run u ON u.id = p.run_id"""

# A comment behind the last word would not be kept in the schema.
KEEP = "keep INTEGER /* 1: retention deletes nothing of this run */"
PURGED_ROWS = "purged_rows INTEGER /* of the rows, those that retention has deleted */"
VIEWS = (
    ROBOT_NOW,
    ROBOT_TRAJECTORY,
    ROBOT_RUN,
    ROBOT_COMMAND,
    ROBOT_EVENT,
    ROBOT_LOG,
    ROBOT_PERIOD,
)


def upgrade() -> None:
    for column in (KEEP, PURGED_ROWS):
        op.execute(f"ALTER TABLE run ADD COLUMN {column} DEFAULT 0 NOT NULL")
    if op.get_context().dialect.name == "sqlite":
        for view in VIEWS:
            op.get_bind().exec_driver_sql(view.strip())
        op.execute("PRAGMA user_version = 3")


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        for view in reversed(VIEWS):
            op.execute(f"DROP VIEW {view.split()[2]}")
        op.execute("PRAGMA user_version = 2")
    op.drop_column("run", "purged_rows")
    op.drop_column("run", "keep")
