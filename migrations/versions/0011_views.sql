CREATE VIEW robot_run AS
/* Runs: how long in simulation and in wall time, how fast, what is left of the rows. */
SELECT r.name AS robot, u.id AS run_id, u.label, strftime('%Y-%m-%d %H:%M:%f', u.started_wall_time_s, 'unixepoch') AS started_utc,
  round(u.last_sim_time_s - u.started_sim_time_s, 3) AS duration_s,
  round(u.last_wall_time_s - u.started_wall_time_s, 3) AS wall_duration_s,
  round((u.last_sim_time_s - u.started_sim_time_s)
    / nullif(u.last_wall_time_s - u.started_wall_time_s, 0), 3) AS real_time_factor,
  u.row_count, u.purged_rows,
  round(u.row_count / nullif(u.last_sim_time_s - u.started_sim_time_s, 0), 2) AS rows_per_s,
  u.start_reason, u.end_reason, u.keep, u.note, u.world, s.controller, s.controller_sha256,
  s.git_commit, u.session_id
FROM run u JOIN robot r ON r.id = u.robot_id JOIN session s ON s.id = u.session_id;
CREATE VIEW robot_command AS
/* Commands: how long each waited to be claimed (or waits), and how long it ran (or runs). */
SELECT r.name AS robot, c.id AS command_id, c.action, c.params, c.status,
  strftime('%Y-%m-%d %H:%M:%f', c.created_wall_time_s, 'unixepoch') AS created_utc,
  round(coalesce(c.claimed_wall_time_s, c.finished_wall_time_s, (julianday('now') - 2440587.5) * 86400.0)
    - c.created_wall_time_s, 3) AS waiting_s,
  round(coalesce(c.finished_wall_time_s, (julianday('now') - 2440587.5) * 86400.0) - c.claimed_wall_time_s, 3) AS running_s,
  c.claimed_sim_time_s, c.finished_sim_time_s,
  CASE WHEN c.finished_sim_time_s >= c.claimed_sim_time_s /* a reset takes it back */
    THEN round(c.finished_sim_time_s - c.claimed_sim_time_s, 3) END AS running_sim_s,
  c.result, c.error, c.requested_by, c.session_id
FROM command c JOIN robot r ON r.id = c.robot_id;
CREATE VIEW robot_event AS
/* Events: what changed (name, from_value, to_value), resets, pauses, dropped rows. */
SELECT (
  SELECT r.name FROM run u JOIN robot r ON r.id = u.robot_id WHERE u.id = e.run_id) AS robot,
  e.run_id, e.id AS event_id, e.sim_time_s,
  strftime('%Y-%m-%d %H:%M:%f', e.wall_time_s, 'unixepoch') AS utc, e.kind, e.name,
  json_extract(j, '$.from') AS from_value, json_extract(j, '$.to') AS to_value, e.data
FROM (SELECT *, CASE WHEN json_valid(data) THEN data END AS j FROM event) e;
CREATE VIEW robot_period AS
/* How long a text or flag of the state kept a value. Signals that never changed have none. */
SELECT (
  SELECT r.name FROM run u JOIN robot r ON r.id = u.robot_id WHERE u.id = p.run_id) AS robot,
  p.run_id, p.name AS signal, p.value, p.start_s,
  coalesce(p.next_s, u.last_sim_time_s) AS end_s,
  round(coalesce(p.next_s, u.last_sim_time_s) - p.start_s, 3) AS duration_s
FROM (
  SELECT run_id, name, value, start_s,
    lead(start_s) OVER (PARTITION BY run_id, name ORDER BY start_s, id, side) AS next_s
  FROM (
    SELECT e.run_id, e.name, e.id, k.value AS side,
      CASE k.value WHEN 0 THEN coalesce((SELECT min(f.sim_time_s) FROM state f WHERE f.run_id = v.id AND f.sim_time_s <= e.sim_time_s AND v.purged_rows = 0), v.started_sim_time_s /* purged */) ELSE e.sim_time_s END AS start_s,
      CASE WHEN json_valid(e.data)
        THEN json_extract(e.data, CASE k.value WHEN 0 THEN '$.from' ELSE '$.to' END) END AS value
    FROM event e JOIN run v ON v.id = e.run_id CROSS JOIN json_each('[0, 1]') k
    WHERE e.kind = 'change' AND (k.value = 1 OR NOT EXISTS (
      SELECT 1 FROM event b
      WHERE b.run_id = e.run_id AND b.kind = 'change' AND b.name = e.name AND b.id < e.id))
  ) c
) p JOIN run u ON u.id = p.run_id;
CREATE VIEW robot_log AS
/* Log lines with their simulation time. */
SELECT (
  SELECT r.name FROM run u JOIN robot r ON r.id = u.robot_id WHERE u.id = l.run_id) AS robot,
  l.run_id, l.id AS log_id, l.sim_time_s,
  strftime('%Y-%m-%d %H:%M:%f', l.wall_time_s, 'unixepoch') AS utc, l.level, l.source, l.logger, l.message
FROM log l;
CREATE VIEW robot_parameter AS
/* The values that parameters had in each run, each from a time on; true and false as text. */
SELECT r.name AS robot, v.run_id, v.name,
  CASE json_type(v.j) WHEN 'true' THEN 'true' WHEN 'false' THEN 'false'
    ELSE json_extract(v.j, '$') END AS value,
  p.unit, v.sim_time_s AS since_s, strftime('%Y-%m-%d %H:%M:%f', v.wall_time_s, 'unixepoch') AS utc, v.is_default, v.set_by, v.command_id
FROM (SELECT *, CASE WHEN json_valid(value) THEN value END AS j FROM parameter_value) v
JOIN run u ON u.id = v.run_id JOIN robot r ON r.id = u.robot_id
LEFT JOIN parameter p ON p.robot_id = u.robot_id AND p.name = v.name;
CREATE VIEW all_state AS
/* All states of a run, those that only kept stretches have included: they have no state_id. */
SELECT id AS state_id, run_id, sim_time_s, wall_time_s, data, replaced FROM state
UNION ALL
SELECT NULL, run_id, sim_time_s, wall_time_s, data, replaced FROM kept_state;
CREATE VIEW robot_kept AS
/* Stretches that are kept at full rate: from when to when, why, how many states each has. */
SELECT r.name AS robot, k.run_id, k.id AS stretch_id, k.start_sim_time_s AS start_s,
  min(k.end_sim_time_s, max(u.last_sim_time_s, k.start_sim_time_s)) AS end_s,
  (SELECT count(*) FROM all_state s WHERE s.run_id = k.run_id
    AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) AS states,
  strftime('%Y-%m-%d %H:%M:%f', k.wall_time_s, 'unixepoch') AS utc, k.reason
FROM kept_stretch k JOIN run u ON u.id = k.run_id JOIN robot r ON r.id = u.robot_id;
CREATE VIEW robot_now AS
/* The newest state of each robot, how old it is and how the robot moves. Speeds as published. */
SELECT robot, run_id, end_reason, sim_time_s, round((julianday('now') - 2440587.5) * 86400.0 - wall_time_s, 1) AS age_s,
  (SELECT json_extract(j, p.path) * CASE p.unit WHEN 'mm' THEN 0.001 WHEN 'cm' THEN 0.01 WHEN 'km' THEN 1000 ELSE 1 END
    FROM signal p JOIN signal o
      ON o.robot_id = p.robot_id AND o.role = 'y' || substr(p.role, 2)
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'x' AND 'x9'
      AND json_type(j, p.path) IN ('integer', 'real') AND json_type(j, o.path) IN ('integer', 'real')
    ORDER BY p.role LIMIT 1) AS x_m,
  (SELECT json_extract(j, p.path) * CASE p.unit WHEN 'mm' THEN 0.001 WHEN 'cm' THEN 0.01 WHEN 'km' THEN 1000 ELSE 1 END
    FROM signal p JOIN signal o
      ON o.robot_id = p.robot_id AND o.role = 'x' || substr(p.role, 2)
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'y' AND 'y9'
      AND json_type(j, p.path) IN ('integer', 'real') AND json_type(j, o.path) IN ('integer', 'real')
    ORDER BY p.role LIMIT 1) AS y_m,
  (SELECT json_extract(j, p.path) * CASE p.unit WHEN 'deg' THEN 0.017453292519943295 ELSE 1 END FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'yaw' AND 'yaw9'
      AND json_type(j, p.path) IN ('integer', 'real') ORDER BY p.role LIMIT 1) AS yaw_rad,
  (SELECT json_extract(j, p.path) FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'mode' AND 'mode9'
      AND json_type(j, p.path) IN ('text', 'integer') ORDER BY p.role LIMIT 1) AS mode,
  (SELECT json_extract(j, p.path) FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'speed' AND 'speed9'
      AND json_type(j, p.path) IN ('integer', 'real') ORDER BY p.role LIMIT 1) AS speed,
  (SELECT json_extract(j, p.path) FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'commanded_speed' AND 'commanded_speed9'
      AND json_type(j, p.path) IN ('integer', 'real') ORDER BY p.role LIMIT 1) AS commanded_speed,
  data, replaced
FROM (
  SELECT r.id AS robot_id, r.name AS robot, u.id AS run_id, u.end_reason, s.sim_time_s,
    s.wall_time_s, s.data, s.replaced, CASE WHEN json_valid(s.data) THEN s.data END AS j
  FROM robot r
  LEFT JOIN run u ON u.id = (SELECT max(id) FROM run WHERE robot_id = r.id)
  LEFT JOIN state s ON s.id = (
    SELECT id FROM state WHERE run_id = u.id ORDER BY sim_time_s DESC, id DESC LIMIT 1)
) s;
CREATE VIEW robot_trajectory AS
/* How each robot moved, row by row: ask with run_id = ... and a time. Speeds as published. */
SELECT (SELECT r.name FROM robot r WHERE r.id = s.robot_id) AS robot,
  s.run_id, s.id AS state_id, s.sim_time_s,
  strftime('%Y-%m-%d %H:%M:%f', s.wall_time_s, 'unixepoch') AS utc,
  (SELECT json_extract(j, p.path) * CASE p.unit WHEN 'mm' THEN 0.001 WHEN 'cm' THEN 0.01 WHEN 'km' THEN 1000 ELSE 1 END
    FROM signal p JOIN signal o
      ON o.robot_id = p.robot_id AND o.role = 'y' || substr(p.role, 2)
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'x' AND 'x9'
      AND json_type(j, p.path) IN ('integer', 'real') AND json_type(j, o.path) IN ('integer', 'real')
    ORDER BY p.role LIMIT 1) AS x_m,
  (SELECT json_extract(j, p.path) * CASE p.unit WHEN 'mm' THEN 0.001 WHEN 'cm' THEN 0.01 WHEN 'km' THEN 1000 ELSE 1 END
    FROM signal p JOIN signal o
      ON o.robot_id = p.robot_id AND o.role = 'x' || substr(p.role, 2)
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'y' AND 'y9'
      AND json_type(j, p.path) IN ('integer', 'real') AND json_type(j, o.path) IN ('integer', 'real')
    ORDER BY p.role LIMIT 1) AS y_m,
  (SELECT json_extract(j, p.path) * CASE p.unit WHEN 'deg' THEN 0.017453292519943295 ELSE 1 END FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'yaw' AND 'yaw9'
      AND json_type(j, p.path) IN ('integer', 'real') ORDER BY p.role LIMIT 1) AS yaw_rad,
  (SELECT json_extract(j, p.path) FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'mode' AND 'mode9'
      AND json_type(j, p.path) IN ('text', 'integer') ORDER BY p.role LIMIT 1) AS mode,
  (SELECT json_extract(j, p.path) FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'speed' AND 'speed9'
      AND json_type(j, p.path) IN ('integer', 'real') ORDER BY p.role LIMIT 1) AS speed,
  (SELECT json_extract(j, p.path) FROM signal p
    WHERE p.robot_id = s.robot_id AND p.role BETWEEN 'commanded_speed' AND 'commanded_speed9'
      AND json_type(j, p.path) IN ('integer', 'real') ORDER BY p.role LIMIT 1) AS commanded_speed, s.replaced
FROM (SELECT *, CASE WHEN json_valid(data) THEN data END AS j, (SELECT robot_id FROM run WHERE id = run_id) AS robot_id FROM state) s;
CREATE VIEW robot_statistics AS
/* What the numbers of a signal come to in each group of about 1,024 rows, also of purged rows. */
SELECT r.name AS robot, g.run_id, s.name AS signal, g.start_sim_time_s AS start_s,
  g.end_sim_time_s AS end_s, c.row_count, c.value_count, c.min, c.max,
  c.sum / nullif(c.value_count, 0) AS mean, c.first, c.last, c.largest_step, c.change_count
FROM chunk c JOIN row_group g ON g.id = c.group_id AND g.is_complete
JOIN signal s ON s.id = c.signal_id JOIN robot r ON r.id = s.robot_id;

CREATE TRIGGER state_ids_stay AFTER DELETE ON state
WHEN old.id > (SELECT coalesce(max(id), 0) FROM state)
BEGIN UPDATE recording SET reserved_state_id = max(reserved_state_id, old.id); END;
CREATE TRIGGER request_stays BEFORE DELETE ON request
BEGIN SELECT RAISE(ABORT, 'requests are never deleted'); END;
CREATE TRIGGER request_stays_as_it_was BEFORE UPDATE OF
  id, uuid, wall_time_s, client, client_version, transport, tool, arguments ON request
BEGIN SELECT RAISE(ABORT, 'what was asked for cannot be changed'); END;
CREATE TRIGGER command_of_request BEFORE DELETE ON command WHEN old.request_id IS NOT NULL
BEGIN UPDATE request SET purged_commands = json_insert(coalesce(purged_commands, '[]'), '$[#]',
  json_array(old.id, old.action, old.status)) WHERE id = old.request_id; END
