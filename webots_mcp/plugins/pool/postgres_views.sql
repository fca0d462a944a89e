-- The views of a pool in PostgreSQL, as schema.sql has them of a recording. postgres_pool.py
-- writes out NOW_S and UTC(...).
CREATE VIEW robot_run AS
SELECT u.recording_uuid, r.name AS robot, u.id AS run_id, u.label,
  UTC(u.started_wall_time_s) AS started_utc,
  round((u.last_sim_time_s - u.started_sim_time_s)::numeric, 3)::double precision AS duration_s,
  round((u.last_wall_time_s - u.started_wall_time_s)::numeric, 3)::double precision
    AS wall_duration_s,
  round(((u.last_sim_time_s - u.started_sim_time_s)
    / nullif(u.last_wall_time_s - u.started_wall_time_s, 0))::numeric, 3)::double precision
    AS real_time_factor,
  u.row_count, u.purged_rows,
  round((u.row_count / nullif(u.last_sim_time_s - u.started_sim_time_s, 0))::numeric, 2)::double precision
    AS rows_per_s,
  u.start_reason, u.end_reason, u.keep, u.note, u.world, s.controller, s.controller_sha256,
  s.git_commit, u.session_id
FROM run u JOIN robot r ON r.recording_uuid = u.recording_uuid AND r.id = u.robot_id
JOIN session s ON s.recording_uuid = u.recording_uuid AND s.id = u.session_id;
CREATE VIEW robot_command AS
SELECT c.recording_uuid, r.name AS robot, c.id AS command_id, c.action, c.params,
  c.status, UTC(c.created_wall_time_s) AS created_utc,
  round((coalesce(c.claimed_wall_time_s, c.finished_wall_time_s, NOW_S)
    - c.created_wall_time_s)::numeric, 3)::double precision
    AS waiting_s,
  round((coalesce(c.finished_wall_time_s, NOW_S)
    - c.claimed_wall_time_s)::numeric, 3)::double precision
    AS running_s,
  c.claimed_sim_time_s, c.finished_sim_time_s,
  CASE WHEN c.finished_sim_time_s >= c.claimed_sim_time_s /* a reset takes it back */
    THEN round((c.finished_sim_time_s - c.claimed_sim_time_s)::numeric, 3)::double precision END
    AS running_sim_s,
  c.result, c.error, c.requested_by, c.session_id
FROM command c JOIN robot r ON r.recording_uuid = c.recording_uuid AND r.id = c.robot_id;
CREATE VIEW robot_event AS
SELECT e.recording_uuid, (SELECT r.name FROM run u JOIN robot r USING (recording_uuid)
    WHERE u.recording_uuid = e.recording_uuid AND u.id = e.run_id AND r.id = u.robot_id) AS robot,
  e.run_id, e.id AS event_id, e.sim_time_s, UTC(e.wall_time_s) AS utc, e.kind, e.name,
  e.data ->> 'from' AS from_value, e.data ->> 'to' AS to_value, e.data
FROM event e;
CREATE VIEW robot_log AS
SELECT l.recording_uuid, (SELECT r.name FROM run u JOIN robot r USING (recording_uuid)
    WHERE u.recording_uuid = l.recording_uuid AND u.id = l.run_id AND r.id = u.robot_id) AS robot,
  l.run_id, l.id AS log_id, l.sim_time_s, UTC(l.wall_time_s) AS utc, l.level, l.source,
  l.logger, l.message
FROM log l;
CREATE VIEW robot_statistics AS
SELECT g.recording_uuid, r.name AS robot, g.run_id, s.name AS signal,
  g.start_sim_time_s AS start_s, g.end_sim_time_s AS end_s, c.row_count, c.value_count, c.min,
  c.max, c.sum / nullif(c.value_count, 0) AS mean, c.first, c.last, c.largest_step, c.change_count
FROM chunk c JOIN row_group g ON g.recording_uuid = c.recording_uuid AND g.id = c.group_id
JOIN signal s ON s.recording_uuid = c.recording_uuid AND s.id = c.signal_id
JOIN robot r ON r.recording_uuid = s.recording_uuid AND r.id = s.robot_id;
