-- Fifteen questions for the sqlite3 shell:
--
--     sqlite3 -box mcp_data/webots.db < examples/queries.sql
--
-- They may be asked while a robot records. Those about one run ask for the newest with a hundred
-- rows or more; another number in the view below (robot_run lists them) chooses another. The names
-- in json_extract(data, '$...') are those that the controller publishes: here the demo's. The
-- examples are the answers of one recording: `webots-mcp demo --keep`, ended after 86 s.

CREATE TEMP VIEW IF NOT EXISTS chosen AS SELECT max(id) AS run_id FROM run WHERE row_count >= 100;

-- 1. What is each robot doing, and how old is that?
-- Example:
--     robot  run_id  sim_time_s  age_s  x_m    y_m    mode
--     rover  2       86.384      39.4   -0.65  -1.49  cruise
SELECT robot, run_id, sim_time_s, age_s, round(x_m, 2) AS x_m, round(y_m, 2) AS y_m, mode
FROM robot_now;

-- 2. In which mode is it, and since when? The same of every other text and flag.
-- Example:
--     signal  value   since_s  for_s
--     mode    cruise  77.824   8.624
SELECT signal, value, max(start_s) AS since_s, duration_s AS for_s
FROM robot_period WHERE run_id = (SELECT run_id FROM chosen) GROUP BY signal;

-- 3. Since when has it not left a circle of 5 cm around where it is now?
-- Example:
--     robot  since_s  for_s
--     rover  86.144   0.24
SELECT n.robot, max(t.sim_time_s) AS since_s, round(n.sim_time_s - max(t.sim_time_s), 2) AS for_s
FROM robot_now n JOIN robot_trajectory t USING (run_id)
WHERE (t.x_m - n.x_m) * (t.x_m - n.x_m) + (t.y_m - n.y_m) * (t.y_m - n.y_m) > 0.05 * 0.05
GROUP BY n.robot;

-- 4. How long was it in each mode, and how often did it enter it?
-- Example:
--     mode    times  total_s  percent
--     cruise  18     78.03    90.3
--     turn    17     8.4      9.7
SELECT value AS mode, count(*) AS times, round(sum(duration_s), 2) AS total_s,
  round(100 * sum(duration_s) / sum(sum(duration_s)) OVER (), 1) AS percent
FROM robot_period WHERE run_id = (SELECT run_id FROM chosen) AND signal = 'mode'
GROUP BY value ORDER BY total_s DESC;

-- 5. How often did it change its mode, run by run?
-- Example:
--     robot  run_id  changes  per_minute
--     rover  1       4        22.9
--     rover  2       34       23.6
SELECT r.robot, r.run_id, count(e.event_id) AS changes,
  round(60 * count(e.event_id) / r.duration_s, 1) AS per_minute
FROM robot_run r LEFT JOIN robot_event e
  ON e.run_id = r.run_id AND e.kind = 'change' AND e.name = 'mode'
GROUP BY r.run_id;

-- 6. How close did the left sensor come to something, when, and in which mode?
-- Example:
--     closest_m          sim_time_s  mode
--     0.259962077188689  7.184       turn
SELECT min(json_extract(data, '$.distance_m.left')) AS closest_m, sim_time_s,
  json_extract(data, '$.mode') AS mode
FROM state WHERE run_id = (SELECT run_id FROM chosen);

-- 7. Which commands did not come to a good end, and why? In all runs.
-- Example:
--     (none)
SELECT command_id, action, params, status, waiting_s, error
FROM robot_command WHERE status NOT IN ('pending', 'claimed', 'done');

-- 8. Which commands took longest? In all runs.
-- Example:
--     command_id  action      status  waiting_s  running_s  running_sim_s
--     5           screenshot  done    0.008      0.151      0.016
--     3           step        done    0.002      0.023      0.08
--     6           reset       done    0.012      0.019
--     2           pause       done    0.006      0.001      0.0
--     4           resume      done    0.007      0.001      0.0
SELECT command_id, action, status, waiting_s, running_s, running_sim_s
FROM robot_command ORDER BY running_s DESC LIMIT 5;

-- 9. Where does the recording have gaps of more than ten times its usual interval?
-- Example:
--     (none)
SELECT before_s, sim_time_s AS after_s, round(sim_time_s - before_s, 3) AS gap_s
FROM (
  SELECT run_id, sim_time_s, lag(sim_time_s) OVER (ORDER BY sim_time_s, id) AS before_s
  FROM state WHERE run_id = (SELECT run_id FROM chosen)
) JOIN robot_run USING (run_id) WHERE sim_time_s - before_s > 10 / rows_per_s;

-- 10. How far did it drive? (sqrt is there where SQLite was built with its math functions.)
-- From row to row, without smoothing: noise of the position adds to it, also while it stands.
-- The server's tools and `webots-mcp compare` tell the distance without that noise.
-- Example:
--     run_id  distance_m
--     2       18.701
SELECT run_id, round(sum(sqrt(dx_m * dx_m + dy_m * dy_m)), 3) AS distance_m
FROM (
  SELECT run_id, x_m - lag(x_m) OVER by_time AS dx_m, y_m - lag(y_m) OVER by_time AS dy_m
  FROM robot_trajectory WHERE run_id = (SELECT run_id FROM chosen)
  WINDOW by_time AS (PARTITION BY run_id ORDER BY sim_time_s, state_id)
) GROUP BY run_id;

-- 11. Which are the last pictures? In all runs; the paths begin in the folder of the database.
-- Example:
--     run_id  sim_time_s  kind    device  path                            pixels
--     2       86.144      camera  camera  camera/rover.camera.000020.png  160 x 120
--     2       81.136      camera  camera  camera/rover.camera.000019.png  160 x 120
--     2       76.128      camera  camera  camera/rover.camera.000018.png  160 x 120
--     2       71.12       camera  camera  camera/rover.camera.000017.png  160 x 120
--     2       66.112      camera  camera  camera/rover.camera.000016.png  160 x 120
SELECT run_id, sim_time_s, kind, device, path, width || ' x ' || height AS pixels
FROM image ORDER BY id DESC LIMIT 5;

-- 12. What was logged in the five seconds before the mode last changed?
-- Example:
--     changed_s  sim_time_s  level  message
--     77.824     74.944      info   cruise -> turn
--     77.824     75.712      info   turn -> cruise
--     77.824     77.328      info   cruise -> turn
--     77.824     77.744      info   turn -> cruise
SELECT e.sim_time_s AS changed_s, l.sim_time_s, l.level, l.message
FROM robot_event e JOIN robot_log l
  ON l.run_id = e.run_id AND l.sim_time_s BETWEEN e.sim_time_s - 5 AND e.sim_time_s
WHERE e.event_id = (SELECT max(id) FROM event WHERE kind = 'change' AND name = 'mode'
  AND run_id = (SELECT run_id FROM chosen));

-- 13. How do the last two runs compare?
-- Example:
--     run_id  label  start_reason  end_reason  duration_s  real_time_factor  row_count  controller
--     2              reset         finished    86.432      1.0               1106  2b061532
--     1              start         reset       10.496      1.001             135   2b061532
SELECT run_id, label, start_reason, end_reason, duration_s, real_time_factor, row_count,
  substr(controller_sha256, 1, 8) AS controller
FROM robot_run ORDER BY run_id DESC LIMIT 2;

-- 14. How did the distances go, second by second? The last ten seconds.
-- Example:
--     second  row_count  least_left_m  least_right_m
--     76      7     0.411         1.0
--     77      14    0.349         1.0
--     78      12    1.0           1.0
--     79      13    1.0           1.0
--     80      12    1.0           1.0
SELECT CAST(sim_time_s AS INTEGER) AS second, count(*) AS row_count,
  round(min(json_extract(data, '$.distance_m.left')), 3) AS least_left_m,
  round(min(json_extract(data, '$.distance_m.right')), 3) AS least_right_m
FROM state WHERE run_id = (SELECT run_id FROM chosen)
  AND sim_time_s > (SELECT last_sim_time_s - 10 FROM run JOIN chosen ON run_id = id)
GROUP BY second;

-- 15. Which values were not finite, how often, and from when to when?
-- Example:
--     (none)
SELECT o.key AS path, o.value AS was, count(*) AS row_count,
  min(s.sim_time_s) AS from_s, max(s.sim_time_s) AS to_s
FROM state s JOIN json_each(s.replaced) o WHERE s.run_id = (SELECT run_id FROM chosen)
GROUP BY path, was;
