PRAGMA application_id = 1463962947;
PRAGMA user_version = 11;
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
CREATE TABLE recording (
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */, 
	created_wall_time_s FLOAT NOT NULL, 
	reserved_state_id INTEGER DEFAULT 0 NOT NULL /* no state gets this id or a smaller one: the newest states were deleted up to it */, 
	PRIMARY KEY (uuid)
);
CREATE TABLE robot (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	name TEXT NOT NULL /* Robot.name; #2 is appended where two live at once */, 
	kind TEXT NOT NULL /* Robot, Supervisor, Observer; customData: without a bridge */, 
	devices TEXT /* JSON object: device name to its class */, 
	first_seen_wall_time_s FLOAT NOT NULL, 
	last_seen_wall_time_s FLOAT NOT NULL, 
	CONSTRAINT uq_robot_name UNIQUE (name)
);
CREATE TABLE session (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	robot_id INTEGER NOT NULL, 
	pid INTEGER NOT NULL, 
	host TEXT NOT NULL, 
	instance TEXT NOT NULL /* which Webots started it: the same after a reload */, 
	controller TEXT /* path of the controller file */, 
	controller_sha256 TEXT, 
	git_commit TEXT /* commit checked out around the controller file */, 
	versions TEXT /* JSON object: python, webots_mcp, sqlite */, 
	supervisor INTEGER NOT NULL /* 1 if it may control the simulation */, 
	actions TEXT /* JSON object: registered custom action to its docstring */, 
	started_wall_time_s FLOAT NOT NULL, 
	last_seen_wall_time_s FLOAT NOT NULL /* newest sign of life of its loop */, 
	last_poll_wall_time_s FLOAT /* newest get_command(); null if never called */, 
	moved_wall_time_s FLOAT /* when simulation time was last seen to grow */, 
	sim_time_s FLOAT /* simulation time at last_seen_wall_time_s */, 
	pause_state TEXT /* paused or stepping while the bridge holds the loop */, 
	rows_waiting INTEGER DEFAULT 0 NOT NULL /* rows that still waited in the file beside or in memory */, 
	rows_dropped INTEGER DEFAULT 0 NOT NULL /* rows that could never be written */, 
	last_error TEXT /* newest thing that could not be recorded, and why */, 
	ended_wall_time_s FLOAT, 
	end_reason TEXT /* finished, reload, crashed, superseded */, 
	uuid TEXT /* random (version 4); names the row among those of all machines */, 
	process TEXT /* which process of that pid; null where the system does not tell */, 
	last_seen_monotonic_s FLOAT /* the host's monotonic clock at last_seen_wall_time_s */, 
	extern INTEGER /* 1 where nobody starts the controller again */, 
	mode_before_pause TEXT /* simulation mode to go back to when the pause ends */, 
	last_adopted_entry INTEGER DEFAULT 0 NOT NULL /* number of the last entry taken in from its file beside */, 
	throttle_interval INTEGER /* of so many publish() calls one is recorded */, 
	CONSTRAINT fk_session_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
CREATE INDEX ix_session_robot_id_id ON session (robot_id, id);
CREATE UNIQUE INDEX ix_session_uuid ON session (uuid);
CREATE TABLE run (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	session_id INTEGER NOT NULL, 
	robot_id INTEGER NOT NULL, 
	world TEXT /* path of the world file */, 
	basic_time_step_ms FLOAT, 
	start_reason TEXT NOT NULL /* start, reset or reload */, 
	started_wall_time_s FLOAT NOT NULL, 
	started_sim_time_s FLOAT NOT NULL, 
	last_wall_time_s FLOAT NOT NULL /* last sign of life */, 
	last_sim_time_s FLOAT NOT NULL, 
	ended_wall_time_s FLOAT, 
	end_reason TEXT /* finished, reset, reload, crashed, superseded */, 
	row_count INTEGER DEFAULT 0 NOT NULL /* state rows, as of last_wall_time_s */, 
	label TEXT, 
	note TEXT, 
	keep INTEGER DEFAULT 0 NOT NULL /* 1: retention deletes nothing of this run */, 
	purged_rows INTEGER DEFAULT 0 NOT NULL /* of the rows, those that retention has deleted */, 
	is_chunked INTEGER DEFAULT 0 NOT NULL /* 1 once it has ended and none of its rows wait for a chunk */, 
	uuid TEXT /* random (version 4); names the row among those of all machines */, 
	own_wall_s FLOAT /* wall time in the controller's own code, over its steps; null where none was seen */, 
	step_wait_wall_s FLOAT /* wall time in step(), waiting for Webots */, 
	steps INTEGER /* from the end of one to the end of the next */, 
	CONSTRAINT fk_run_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE CASCADE, 
	CONSTRAINT fk_run_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
CREATE INDEX ix_run_robot_id_id ON run (robot_id, id);
CREATE INDEX ix_run_session_id ON run (session_id);
CREATE UNIQUE INDEX ix_run_uuid ON run (uuid);
CREATE TABLE state (
	id INTEGER NOT NULL, 
	run_id INTEGER NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	data TEXT NOT NULL /* JSON object */, 
	replaced TEXT /* JSON object: path of a replaced value to what it was (nan, inf, ...) */, 
	PRIMARY KEY (id), 
	CONSTRAINT fk_state_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE TRIGGER state_ids_stay AFTER DELETE ON state
WHEN old.id > (SELECT coalesce(max(id), 0) FROM state)
BEGIN UPDATE recording SET reserved_state_id = max(reserved_state_id, old.id); END;
CREATE INDEX ix_state_run_id_sim_time_s ON state (run_id, sim_time_s);
CREATE TABLE signal (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	robot_id INTEGER NOT NULL, 
	name TEXT NOT NULL /* dotted: pose.0, sensors.front, lidar.min */, 
	kind TEXT NOT NULL /* num, bool, text, angle (radians), null (no value yet) */, 
	unit TEXT /* where the name tells it */, 
	path TEXT NOT NULL /* for json_extract(state.data, path) */, 
	reduction TEXT /* count, min, max, mean or argmin of the long array at path */, 
	role TEXT /* x, y, z, yaw, mode, speed, commanded_speed, wheel or commanded_wheel; x2 without an x */, 
	first_seen_wall_time_s FLOAT NOT NULL, 
	min FLOAT /* of all numbers that were put into chunks */, 
	max FLOAT, 
	CONSTRAINT uq_signal_robot_id UNIQUE (robot_id, name), 
	CONSTRAINT fk_signal_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
CREATE INDEX ix_signal_robot_id_role ON signal (robot_id, role) WHERE role IS NOT NULL;
CREATE TABLE meaning (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	robot_id INTEGER /* null: of robot_name */, 
	name TEXT NOT NULL /* signal.name, or a pattern in which * is any text */, 
	source TEXT NOT NULL /* declared or device */, 
	quantity TEXT /* speed, wheel speed, distance, ... */, 
	role TEXT /* measured, commanded, target or limit */, 
	unit TEXT, 
	target_of TEXT /* the signal whose target it is */, 
	same_as TEXT /* the signal that measures the same */, 
	side TEXT, 
	low FLOAT, 
	high FLOAT, 
	set_wall_time_s FLOAT NOT NULL, 
	set_by TEXT NOT NULL /* mcp, cli, project (its file), controller (its code), bridge (the device) */, 
	why TEXT /* of a device: its type, model and sampling period */, 
	robot_name TEXT /* of the project's file: a robot's, or * for all */, 
	CONSTRAINT uq_meaning_robot_id UNIQUE (robot_id, name, source, set_by), 
	CONSTRAINT fk_meaning_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
CREATE TABLE row_group (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	start_sim_time_s FLOAT NOT NULL /* of the first row */, 
	end_sim_time_s FLOAT NOT NULL /* of the last row */, 
	last_state_id INTEGER NOT NULL /* state.id of the last row */, 
	max_state_id INTEGER NOT NULL /* the greatest state.id among them */, 
	row_count INTEGER NOT NULL, 
	stored_row_count INTEGER NOT NULL /* of them, those that retention has left in state */, 
	stored_row_bytes FLOAT NOT NULL /* that one of those takes on the disk */, 
	lost_value_count INTEGER NOT NULL /* that states of it had and chunks cannot hold as they were */, 
	chunk_bytes INTEGER NOT NULL /* that its chunks take on the disk */, 
	is_complete INTEGER NOT NULL /* 1 once all of its chunks are there */, 
	CONSTRAINT fk_row_group_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_row_group_run_id_start_sim_time_s ON row_group (run_id, start_sim_time_s);
CREATE TABLE chunk (
	id INTEGER NOT NULL, 
	group_id INTEGER NOT NULL, 
	run_id INTEGER NOT NULL, 
	signal_id INTEGER NOT NULL /* signal.id; 0: simulation times, -1: wall times, -2: ids of the state rows */, 
	row_count INTEGER NOT NULL /* rows whose state has the signal */, 
	value_count INTEGER NOT NULL /* of them with a value */, 
	change_count INTEGER NOT NULL /* values unlike the one before */, 
	first FLOAT /* of numbers and flags (0, 1), as all that follows */, 
	last FLOAT, 
	min FLOAT, 
	max FLOAT, 
	sum FLOAT, 
	squared_deviations FLOAT /* sum of squared deviations from the mean */, 
	largest_step FLOAT /* largest difference of values that follow each other */, 
	codec TEXT NOT NULL /* how numbers are compressed */, 
	numbers BLOB /* CRC-32, then the numbers compressed */, 
	codes BLOB /* zlib: for each row 0 a number, 1 no such key, else 2 + the place of its label */, 
	labels TEXT /* JSON array; an item that is an array says what was replaced */, 
	PRIMARY KEY (id), 
	CONSTRAINT fk_chunk_group_id FOREIGN KEY(group_id) REFERENCES row_group (id) ON DELETE CASCADE
);
CREATE INDEX ix_chunk_group_id ON chunk (group_id);
CREATE INDEX ix_chunk_statistics ON chunk (run_id, signal_id, group_id, row_count, value_count, change_count, first, last, min, max, sum, squared_deviations, largest_step);
CREATE TABLE watermark (
	name TEXT NOT NULL /* chunk */, 
	state_id INTEGER NOT NULL, 
	PRIMARY KEY (name)
);
CREATE TABLE log (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	level TEXT NOT NULL /* debug, info, ... critical */, 
	source TEXT NOT NULL /* controller, bridge, console or webots */, 
	message TEXT NOT NULL, 
	logger TEXT /* name of the Python logger, where one logged it */, 
	CONSTRAINT fk_log_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_log_run_id_sim_time_s ON log (run_id, sim_time_s);
CREATE TABLE console_line (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	instance TEXT NOT NULL /* session.instance of who said it */, 
	wall_time_s FLOAT NOT NULL, 
	level TEXT NOT NULL, 
	source TEXT NOT NULL /* webots, or console: a controller, not told which; as in log later on */, 
	message TEXT NOT NULL, 
	logger TEXT /* stdout or stderr */
);
CREATE TABLE event (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	kind TEXT NOT NULL /* change, start, reset, reload, pause, resume, dropped, storage, ... */, 
	name TEXT /* the signal that changed, where one did */, 
	data TEXT /* JSON object */, 
	CONSTRAINT fk_event_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_event_run_id_sim_time_s ON event (run_id, sim_time_s);
CREATE TABLE command (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	robot_id INTEGER NOT NULL, 
	action TEXT NOT NULL, 
	params TEXT NOT NULL /* JSON object */, 
	status TEXT NOT NULL /* pending, claimed, then one of done, failed, expired, cancelled, lost */, 
	requested_by TEXT, 
	idempotency_key TEXT /* the same key makes no second command */, 
	created_wall_time_s FLOAT NOT NULL, 
	expires_wall_time_s FLOAT NOT NULL /* if not claimed by then, never run */, 
	claimed_wall_time_s FLOAT, 
	claimed_sim_time_s FLOAT, 
	session_id INTEGER, 
	issued_wall_time_s FLOAT /* when a reset or reload was asked of Webots */, 
	finished_wall_time_s FLOAT, 
	finished_sim_time_s FLOAT, 
	result TEXT /* JSON value */, 
	error TEXT, 
	request_id INTEGER /* the row of request that it was sent for */, 
	CONSTRAINT fk_command_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE, 
	CONSTRAINT uq_command_idempotency_key UNIQUE (idempotency_key), 
	CONSTRAINT fk_command_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE SET NULL
);
CREATE TRIGGER command_of_request BEFORE DELETE ON command WHEN old.request_id IS NOT NULL
BEGIN UPDATE request SET purged_commands = json_insert(coalesce(purged_commands, '[]'), '$[#]',
  json_array(old.id, old.action, old.status)) WHERE id = old.request_id; END;
CREATE INDEX ix_command_claimed ON command (robot_id, id) WHERE status = 'claimed';
CREATE INDEX ix_command_pending ON command (robot_id, id) WHERE status = 'pending';
CREATE INDEX ix_command_session_id ON command (session_id);
CREATE TABLE request (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */, 
	wall_time_s FLOAT NOT NULL, 
	run_id INTEGER /* that went on then */, 
	sim_time_s FLOAT /* of its newest row then */, 
	client TEXT NOT NULL /* the name of the program that asked */, 
	client_version TEXT NOT NULL, 
	transport TEXT NOT NULL /* stdio, http, cli or page */, 
	tool TEXT NOT NULL /* or the command of the command line */, 
	arguments TEXT NOT NULL /* JSON object; without secrets, cut where it is long */, 
	rule TEXT /* by which it was refused: file, line, and what stands there */, 
	finished_wall_time_s FLOAT, 
	outcome TEXT /* answered, refused, what became of its command, or an error */, 
	purged_commands TEXT /* JSON array of [id, action, status] that retention deleted */, 
	CONSTRAINT fk_request_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE SET NULL
);
CREATE TRIGGER request_stays BEFORE DELETE ON request
BEGIN SELECT RAISE(ABORT, 'requests are never deleted'); END;
CREATE TRIGGER request_stays_as_it_was BEFORE UPDATE OF
  id, uuid, wall_time_s, client, client_version, transport, tool, arguments ON request
BEGIN SELECT RAISE(ABORT, 'what was asked for cannot be changed'); END;
CREATE INDEX ix_request_run_id ON request (run_id);
CREATE UNIQUE INDEX ix_request_uuid ON request (uuid);
CREATE TABLE breakpoint (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	robot_id INTEGER /* null: of robot_name */, 
	session_id INTEGER, 
	condition TEXT NOT NULL /* see webots-mcp help conditions */, 
	action TEXT NOT NULL /* pause, log or keep */, 
	after_hits INTEGER DEFAULT 1 NOT NULL /* the action is taken from this hit of a run on */, 
	enabled INTEGER DEFAULT 1 NOT NULL /* 0 once the condition failed */, 
	hit_count INTEGER DEFAULT 0 NOT NULL /* how often it began to hold, in all runs */, 
	created_wall_time_s FLOAT NOT NULL, 
	created_by TEXT /* mcp, cli, project (its file), or controller: its code, for session_id only */, 
	error TEXT /* why the condition failed */, 
	name TEXT /* of an expectation */, 
	expects TEXT /* the condition that is expected to hold; null of a breakpoint */, 
	during TEXT /* while this holds; null: always */, 
	robot_name TEXT /* of the project's expectations: a robot's, or * for all */, 
	CONSTRAINT fk_breakpoint_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE, 
	CONSTRAINT fk_breakpoint_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE SET NULL
);
CREATE INDEX ix_breakpoint_robot_id ON breakpoint (robot_id);
CREATE INDEX ix_breakpoint_session_id ON breakpoint (session_id);
CREATE TABLE kept_stretch (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */, 
	start_sim_time_s FLOAT NOT NULL, 
	end_sim_time_s FLOAT NOT NULL /* ahead of the newest row while it goes on */, 
	wall_time_s FLOAT NOT NULL /* when it was asked for */, 
	reason TEXT NOT NULL /* why it is kept */, 
	CONSTRAINT fk_kept_stretch_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_kept_stretch_run_id_start_sim_time_s ON kept_stretch (run_id, start_sim_time_s);
CREATE UNIQUE INDEX ix_kept_stretch_uuid ON kept_stretch (uuid);
CREATE TABLE kept_state (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	call INTEGER /* its number in the session; null where retention moved it here from state */, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	data TEXT NOT NULL /* JSON object */, 
	replaced TEXT /* as in state */, 
	CONSTRAINT uq_kept_state_run_id UNIQUE (run_id, call), 
	CONSTRAINT fk_kept_state_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_kept_state_run_id_sim_time_s ON kept_state (run_id, sim_time_s);
CREATE TABLE image (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	kind TEXT NOT NULL /* camera, screenshot or kept (of a kept stretch) */, 
	device TEXT /* name of the camera */, 
	path TEXT NOT NULL /* relative to the data folder */, 
	width INTEGER NOT NULL /* pixels */, 
	height INTEGER NOT NULL /* pixels */, 
	size_bytes INTEGER NOT NULL /* of the file */, 
	CONSTRAINT fk_image_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_image_run_id_sim_time_s ON image (run_id, sim_time_s);
CREATE TABLE parameter (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	robot_id INTEGER NOT NULL, 
	session_id INTEGER NOT NULL /* session.id of the controller that did */, 
	name TEXT NOT NULL, 
	kind TEXT NOT NULL /* float, int, bool or str */, 
	default_value TEXT NOT NULL /* JSON value */, 
	low FLOAT /* least value */, 
	high FLOAT /* greatest value */, 
	choices TEXT /* JSON array: the only values that it may have */, 
	doc TEXT NOT NULL, 
	unit TEXT, 
	next_value TEXT /* JSON value that it takes with the next reset of the world */, 
	declared_wall_time_s FLOAT NOT NULL, 
	CONSTRAINT uq_parameter_robot_id UNIQUE (robot_id, name), 
	CONSTRAINT fk_parameter_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
CREATE TABLE parameter_value (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	value TEXT NOT NULL /* JSON value */, 
	is_default INTEGER NOT NULL /* 1 where the code declared it */, 
	set_by TEXT NOT NULL /* code, environment, command or trial */, 
	command_id INTEGER /* command.id that set it, which may have been deleted since */, 
	CONSTRAINT fk_parameter_value_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_parameter_value_run_id_name_id ON parameter_value (run_id, name, id);
CREATE TABLE trial_set (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */, 
	"plan" TEXT NOT NULL /* JSON object */, 
	created_wall_time_s FLOAT NOT NULL, 
	host TEXT /* of the process at work */, 
	pid INTEGER, 
	process TEXT /* which process of that pid; null where the system does not tell */, 
	robot_id INTEGER /* in whose simulation the trials run; null: each in one of its own */, 
	session_id INTEGER /* of the controller that was tried */, 
	former_values TEXT /* JSON object: its parameters before, until they are set back */, 
	stop_reason TEXT /* why it does not go on although trials wait */, 
	CONSTRAINT fk_trial_set_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE SET NULL, 
	CONSTRAINT fk_trial_set_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE SET NULL
);
CREATE INDEX ix_trial_set_robot_id ON trial_set (robot_id);
CREATE INDEX ix_trial_set_session_id ON trial_set (session_id);
CREATE UNIQUE INDEX ix_trial_set_uuid ON trial_set (uuid);
CREATE TABLE trial (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	trial_set_id INTEGER NOT NULL, 
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */, 
	number INTEGER NOT NULL /* its place in the set, from 1 */, 
	parameters TEXT NOT NULL /* JSON object */, 
	status TEXT NOT NULL /* waiting, running, then done, failed or pruned */, 
	run_id INTEGER, 
	score FLOAT /* if it is done */, 
	ended_by TEXT /* for_s, until or prune */, 
	ended_sim_time_s FLOAT /* the end */, 
	error TEXT /* why it failed */, 
	started_wall_time_s FLOAT, 
	finished_wall_time_s FLOAT, 
	pid INTEGER /* of its simulator, while it runs */, 
	process TEXT /* which process of that pid; null where the system does not tell */, 
	CONSTRAINT uq_trial_trial_set_id UNIQUE (trial_set_id, number), 
	CONSTRAINT fk_trial_trial_set_id FOREIGN KEY(trial_set_id) REFERENCES trial_set (id) ON DELETE CASCADE, 
	CONSTRAINT fk_trial_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE SET NULL
);
CREATE INDEX ix_trial_run_id ON trial (run_id);
CREATE UNIQUE INDEX ix_trial_uuid ON trial (uuid);
CREATE TABLE lease (
	name TEXT NOT NULL, 
	holder TEXT NOT NULL, 
	until_wall_time_s FLOAT NOT NULL, 
	PRIMARY KEY (name)
);
CREATE TABLE retention_limit (
	kind TEXT NOT NULL /* state, kept_state, chunk, log, event, image or run */, 
	size_bytes BIGINT /* on the disk; of pictures their files */, 
	row_count BIGINT, 
	age_s FLOAT /* since it was recorded, in wall time */, 
	outlive_factor FLOAT /* run only: what is left of one stays so many times longer than its chunks; 0 for ever */, 
	set_by TEXT NOT NULL /* serve, prune or retain */, 
	set_wall_time_s FLOAT NOT NULL, 
	PRIMARY KEY (kind)
);
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
INSERT INTO alembic_version (version_num) VALUES ('0011');
