PRAGMA application_id = 1463962947;
PRAGMA user_version = 9;
CREATE TABLE breakpoint (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	robot_id INTEGER NOT NULL,
	session_id INTEGER,
	condition TEXT NOT NULL /* see docs/conditions.md */,
	action TEXT NOT NULL /* pause, log or keep */,
	after_hits INTEGER DEFAULT 1 NOT NULL /* the action is taken from this hit of a run on */,
	enabled INTEGER DEFAULT 1 NOT NULL /* 0 once the condition failed */,
	hits INTEGER DEFAULT 0 NOT NULL /* how often it began to hold, in all runs */,
	created_wall_time_s FLOAT NOT NULL,
	created_by TEXT /* mcp, cli or controller: its code, for session_id only */,
	error TEXT /* why the condition failed */,
	CONSTRAINT fk_breakpoint_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE,
	CONSTRAINT fk_breakpoint_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE SET NULL
);
INSERT INTO "breakpoint" VALUES(1,1,NULL,'front < 0.5','log',1,1,2,1700000000.0,'mcp',NULL);
CREATE TABLE change (
	run_id INTEGER NOT NULL,
	signal_id INTEGER NOT NULL /* signal.id, of the run's robot */,
	state_id INTEGER NOT NULL /* state.id of the row, which may have been deleted since */,
	sim_time_s FLOAT NOT NULL,
	value TEXT /* text (its first 200 characters), true, false or null */,
	PRIMARY KEY (run_id, signal_id, state_id),
	CONSTRAINT fk_change_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
)
 WITHOUT ROWID;
INSERT INTO "change" VALUES(1,4,1,0.0,'cruise');
INSERT INTO "change" VALUES(1,4,41,20.0,'turn');
INSERT INTO "change" VALUES(2,4,61,0.0,'wait');
CREATE TABLE coarse_rollup (
	run_id INTEGER NOT NULL,
	signal_id INTEGER NOT NULL /* signal.id, of the run's robot */,
	bucket INTEGER NOT NULL /* floor(sim_time_s / 500) */,
	rows INTEGER DEFAULT 0 NOT NULL /* state rows that held the signal */,
	present INTEGER DEFAULT 0 NOT NULL /* of them with a value */,
	changes INTEGER DEFAULT 0 NOT NULL /* of the values, those unlike the one before in the bucket */,
	first FLOAT /* of numbers and flags (0, 1); null for text, as all that follows */,
	first_sim_time_s FLOAT,
	last FLOAT,
	last_sim_time_s FLOAT,
	min FLOAT,
	min_sim_time_s FLOAT /* of the first such extreme */,
	max FLOAT,
	max_sim_time_s FLOAT /* of the first such extreme */,
	sum FLOAT,
	squares FLOAT /* sum of squared deviations from sum / count */,
	sines FLOAT /* angles only: sum of sines */,
	cosines FLOAT /* angles only: sum of cosines */, largest_step FLOAT /* largest difference of values that follow each other; null in those of older versions */ NULL, first_until_sim_time_s FLOAT /* up to then it had its first number; null in older versions */ NULL, last_since_sim_time_s FLOAT /* from then on it had its last number; null in older versions */ NULL, swings TEXT /* JSON: the swings of what a robot swings with, each as [begin, end, half swings, period in s, amplitude, explained share]; null where they were not looked for */ NULL, standstills TEXT /* JSON, at the signal of x: where the robot stood still, and what shows whether it should have moved; null where that was not looked for */ NULL,
	PRIMARY KEY (run_id, signal_id, bucket),
	CONSTRAINT fk_coarse_rollup_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
)
 WITHOUT ROWID;
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
	CONSTRAINT fk_command_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE,
	CONSTRAINT fk_command_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE SET NULL,
	CONSTRAINT uq_command_idempotency_key UNIQUE (idempotency_key)
);
INSERT INTO "command" VALUES(1,1,'run','{"for_s": 1}','done',NULL,NULL,1700000001.0,1700000009.0,1700000001.5,3.0,1,NULL,1700000002.0,4.0,'{"ended": "time over", "advanced_s": 1.0}',NULL);
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
INSERT INTO "event" VALUES(1,1,20.0,1700000029.5,'change','mode','{"from": "cruise", "to": "turn"}');
INSERT INTO "event" VALUES(2,1,25.0,1700000029.5,'dropped',NULL,'{"rows": 3, "why": "the disk was full"}');
CREATE TABLE image (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	run_id INTEGER NOT NULL,
	sim_time_s FLOAT NOT NULL,
	wall_time_s FLOAT NOT NULL,
	kind TEXT NOT NULL /* camera or screenshot */,
	device TEXT /* name of the camera */,
	path TEXT NOT NULL /* relative to the data folder */,
	width INTEGER NOT NULL /* pixels */,
	height INTEGER NOT NULL /* pixels */,
	bytes INTEGER NOT NULL /* size of the file */,
	CONSTRAINT fk_image_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
INSERT INTO "image" VALUES(1,1,2.0,1700000029.5,'camera','eye','camera/1.png',160,120,1000);
CREATE TABLE kept_state (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	run_id INTEGER NOT NULL,
	call INTEGER /* its number in the session; null where retention moved it here from state */,
	sim_time_s FLOAT NOT NULL,
	wall_time_s FLOAT NOT NULL,
	data TEXT NOT NULL /* JSON object */,
	odd TEXT /* as in state */,
	CONSTRAINT fk_kept_state_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE,
	CONSTRAINT uq_kept_state_run_id UNIQUE (run_id, call)
);
INSERT INTO "kept_state" VALUES(1,1,NULL,21.25,1700000029.5,'{"pose": [4.25, 0.0, 0.0], "mode": "turn", "front": 0.9}',NULL);
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
INSERT INTO "kept_stretch" VALUES(1,1,'00000000-0000-4000-8000-000000000004',21.0,22.0,1700000000.0,'a look');
CREATE TABLE lease (
	name TEXT NOT NULL,
	holder TEXT NOT NULL,
	until_wall_time_s FLOAT NOT NULL,
	PRIMARY KEY (name)
);
CREATE TABLE log (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	run_id INTEGER NOT NULL,
	sim_time_s FLOAT NOT NULL,
	wall_time_s FLOAT NOT NULL,
	level TEXT NOT NULL /* debug, info, ... critical */,
	source TEXT NOT NULL /* controller or bridge */,
	message TEXT NOT NULL, logger TEXT /* name of the Python logger, where one logged it */ NULL,
	CONSTRAINT fk_log_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
INSERT INTO "log" VALUES(1,1,3.0,1700000029.5,'warning','controller','hello',NULL);
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
	CONSTRAINT fk_parameter_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE,
	CONSTRAINT uq_parameter_robot_id UNIQUE (robot_id, name)
);
INSERT INTO "parameter" VALUES(1,1,1,'kp','float','1.0',0.0,9.0,NULL,'Gain.',NULL,NULL,1700000000.0);
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
INSERT INTO "parameter_value" VALUES(1,1,'kp',3.0,1700000001.5,'2.0',0,'command',1);
CREATE TABLE recent_rollup (
	run_id INTEGER NOT NULL,
	bucket INTEGER NOT NULL /* floor(sim_time_s / 10) */,
	signal_id INTEGER NOT NULL /* signal.id, of the run's robot */,
	rows INTEGER DEFAULT 0 NOT NULL /* state rows that held the signal */,
	present INTEGER DEFAULT 0 NOT NULL /* of them with a value */,
	changes INTEGER DEFAULT 0 NOT NULL /* of the values, those unlike the one before in the bucket */,
	first FLOAT /* of numbers and flags (0, 1); null for text, as all that follows */,
	first_sim_time_s FLOAT,
	last FLOAT,
	last_sim_time_s FLOAT,
	min FLOAT,
	min_sim_time_s FLOAT /* of the first such extreme */,
	max FLOAT,
	max_sim_time_s FLOAT /* of the first such extreme */,
	sum FLOAT,
	squares FLOAT /* sum of squared deviations from sum / count */,
	sines FLOAT /* angles only: sum of sines */,
	cosines FLOAT /* angles only: sum of cosines */, largest_step FLOAT /* largest difference of values that follow each other; null in those of older versions */ NULL, first_until_sim_time_s FLOAT /* up to then it had its first number; null in older versions */ NULL, last_since_sim_time_s FLOAT /* from then on it had its last number; null in older versions */ NULL,
	PRIMARY KEY (run_id, bucket, signal_id),
	CONSTRAINT fk_recent_rollup_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
)
 WITHOUT ROWID;
CREATE TABLE recording (
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */,
	created_wall_time_s FLOAT NOT NULL,
	PRIMARY KEY (uuid)
);
INSERT INTO "recording" VALUES('00000000-0000-4000-8000-000000000002',1700000000.0);
CREATE TABLE retention_limit (
	kind TEXT NOT NULL /* state, rollup, log, event, image or run */,
	size_bytes BIGINT /* on the disk; of pictures their files */,
	rows BIGINT,
	age_s FLOAT /* since it was recorded, in wall time */,
	times FLOAT /* run only: what is left of one stays so many times longer than its states; 0 for ever */,
	set_by TEXT NOT NULL /* serve, prune or retain */,
	set_wall_time_s FLOAT NOT NULL,
	PRIMARY KEY (kind)
);
INSERT INTO "retention_limit" VALUES('run',NULL,NULL,NULL,5.0,'retain',1700000000.0);
INSERT INTO "retention_limit" VALUES('state',NULL,30,NULL,NULL,'prune',1.79543164782650494577e+09);
CREATE TABLE robot (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	name TEXT NOT NULL /* Robot.name; #2 is appended where two live at once */,
	kind TEXT NOT NULL /* Robot or Supervisor */,
	devices TEXT /* JSON object: device name to its class */,
	first_seen_wall_time_s FLOAT NOT NULL,
	last_seen_wall_time_s FLOAT NOT NULL,
	CONSTRAINT uq_robot_name UNIQUE (name)
);
INSERT INTO "robot" VALUES(1,'rover','Supervisor','{"front": "DistanceSensor", "eye": "Camera", "lidar": "Lidar"}',1700000000.0,1700000000.0);
CREATE TABLE rollup (
	run_id INTEGER NOT NULL,
	signal_id INTEGER NOT NULL /* signal.id, of the run's robot */,
	bucket INTEGER NOT NULL /* floor(sim_time_s / 10) */,
	rows INTEGER DEFAULT 0 NOT NULL /* state rows that held the signal */,
	present INTEGER DEFAULT 0 NOT NULL /* of them with a value */,
	changes INTEGER DEFAULT 0 NOT NULL /* of the values, those unlike the one before in the bucket */,
	first FLOAT /* of numbers and flags (0, 1); null for text, as all that follows */,
	first_sim_time_s FLOAT,
	last FLOAT,
	last_sim_time_s FLOAT,
	min FLOAT,
	min_sim_time_s FLOAT /* of the first such extreme */,
	max FLOAT,
	max_sim_time_s FLOAT /* of the first such extreme */,
	sum FLOAT,
	squares FLOAT /* sum of squared deviations from sum / count */,
	sines FLOAT /* angles only: sum of sines */,
	cosines FLOAT /* angles only: sum of cosines */, largest_step FLOAT /* largest difference of values that follow each other; null in those of older versions */ NULL, first_until_sim_time_s FLOAT /* up to then it had its first number; null in older versions */ NULL, last_since_sim_time_s FLOAT /* from then on it had its last number; null in older versions */ NULL,
	PRIMARY KEY (run_id, signal_id, bucket),
	CONSTRAINT fk_rollup_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
)
 WITHOUT ROWID;
INSERT INTO "rollup" VALUES(1,1,0,20,20,19,0.0,0.0,1.9,9.5,0.0,0.0,1.9,9.5,19.0,6.65,NULL,NULL,1.00000000000000088817e-01,0.0,9.5);
INSERT INTO "rollup" VALUES(1,1,1,20,20,19,2.0,10.0,3.9,19.5,2.0,10.0,3.9,19.5,59.0,6.64999999999999946709e+00,NULL,NULL,1.00000000000000088817e-01,10.0,19.5);
INSERT INTO "rollup" VALUES(1,1,2,20,20,19,4.0,20.0,5.9,29.5,4.0,20.0,5.9,29.5,99.0,6.65,NULL,NULL,1.00000000000000532907e-01,20.0,29.5);
INSERT INTO "rollup" VALUES(1,2,0,20,20,0,0.0,0.0,0.0,9.5,0.0,0.0,0.0,0.0,0.0,0.0,NULL,NULL,0.0,9.5,0.0);
INSERT INTO "rollup" VALUES(1,2,1,20,20,0,0.0,10.0,0.0,19.5,0.0,10.0,0.0,10.0,0.0,0.0,NULL,NULL,0.0,19.5,10.0);
INSERT INTO "rollup" VALUES(1,2,2,20,20,0,0.0,20.0,0.0,29.5,0.0,20.0,0.0,20.0,0.0,0.0,NULL,NULL,0.0,29.5,20.0);
INSERT INTO "rollup" VALUES(1,3,0,20,20,0,0.0,0.0,0.0,9.5,0.0,0.0,0.0,0.0,0.0,0.0,0.0,20.0,0.0,9.5,0.0);
INSERT INTO "rollup" VALUES(1,3,1,20,20,0,0.0,10.0,0.0,19.5,0.0,10.0,0.0,10.0,0.0,0.0,0.0,20.0,0.0,19.5,10.0);
INSERT INTO "rollup" VALUES(1,3,2,20,20,0,0.0,20.0,0.0,29.5,0.0,20.0,0.0,20.0,0.0,0.0,0.0,20.0,0.0,29.5,20.0);
INSERT INTO "rollup" VALUES(1,4,0,20,20,0,NULL,0.0,NULL,9.5,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "rollup" VALUES(1,4,1,20,20,0,NULL,10.0,NULL,19.5,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "rollup" VALUES(1,4,2,20,20,0,NULL,20.0,NULL,29.5,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "rollup" VALUES(1,5,0,20,20,0,1.0,0.0,1.0,9.5,1.0,0.0,1.0,0.0,20.0,0.0,NULL,NULL,0.0,9.5,0.0);
INSERT INTO "rollup" VALUES(1,5,1,20,20,0,1.0,10.0,1.0,19.5,1.0,10.0,1.0,10.0,20.0,0.0,NULL,NULL,0.0,19.5,10.0);
INSERT INTO "rollup" VALUES(1,5,2,20,19,0,1.0,20.0,1.0,29.5,1.0,20.0,1.0,20.0,19.0,0.0,NULL,NULL,0.0,29.5,20.0);
INSERT INTO "rollup" VALUES(2,1,0,10,10,0,0.0,0.0,0.0,4.5,0.0,0.0,0.0,0.0,0.0,0.0,NULL,NULL,0.0,4.5,0.0);
INSERT INTO "rollup" VALUES(2,2,0,10,10,0,0.0,0.0,0.0,4.5,0.0,0.0,0.0,0.0,0.0,0.0,NULL,NULL,0.0,4.5,0.0);
INSERT INTO "rollup" VALUES(2,3,0,10,10,0,0.0,0.0,0.0,4.5,0.0,0.0,0.0,0.0,0.0,0.0,0.0,10.0,0.0,4.5,0.0);
INSERT INTO "rollup" VALUES(2,4,0,10,10,0,NULL,0.0,NULL,4.5,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "rollup" VALUES(2,5,0,10,10,0,1.0,0.0,1.0,4.5,1.0,0.0,1.0,0.0,10.0,0.0,NULL,NULL,0.0,4.5,0.0);
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
	end_reason TEXT /* finished, reset, reload, crashed, replaced */,
	rows INTEGER DEFAULT 0 NOT NULL /* state rows, as of last_wall_time_s */,
	label TEXT,
	note TEXT, keep INTEGER /* 1: retention deletes nothing of this run */ DEFAULT 0 NOT NULL, purged_rows INTEGER /* of the rows, those that retention has deleted */ DEFAULT 0 NOT NULL, uuid TEXT /* random (version 4); names the row among those of all machines */ NULL, rolled_state_id INTEGER DEFAULT 0 /* last state.id in the rollups, where beyond the watermark */ NOT NULL, coarse_end INTEGER /* buckets of coarse_rollup below it are complete; null before the first */ NULL,
	CONSTRAINT fk_run_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE,
	CONSTRAINT fk_run_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE CASCADE
);
INSERT INTO "run" VALUES(1,1,1,'/project/worlds/arena.wbt',16.0,'start',1700000000.0,0.0,1700000029.5,29.5,1700000029.5,'reset',60,NULL,NULL,0,30,'00000000-0000-4000-8000-000000000003',60,NULL);
INSERT INTO "run" VALUES(2,1,1,'/project/worlds/arena.wbt',16.0,'reset',1700000029.5,0.0,1700000044.5,4.5,1700000044.5,'replaced',10,'second',NULL,0,0,'00000000-0000-4000-8000-000000000005',70,NULL);
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
	hold TEXT /* paused or stepping while the bridge holds the loop */,
	rows_waiting INTEGER DEFAULT 0 NOT NULL /* rows that still waited in the file beside or in memory */,
	rows_dropped INTEGER DEFAULT 0 NOT NULL /* rows that could never be written */,
	last_error TEXT /* newest thing that could not be recorded, and why */,
	ended_wall_time_s FLOAT,
	end_reason TEXT /* finished, reload, crashed, replaced */, uuid TEXT /* random (version 4); names the row among those of all machines */ NULL, process TEXT /* which process of that pid; null where the system does not tell */ NULL, last_seen_monotonic_s FLOAT /* the host's monotonic clock at last_seen_wall_time_s */ NULL, extern INTEGER /* 1 where nobody starts the controller again */ NULL, hold_mode TEXT /* simulation mode to go back to when the hold ends */ NULL, adopted_rows INTEGER DEFAULT 0 /* number of the last entry taken in from its file beside */ NOT NULL, throttle_interval INTEGER /* of so many publish() calls one is recorded */ NULL,
	CONSTRAINT fk_session_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
INSERT INTO "session" VALUES(1,1,7,'nowhere','webots-1','/project/controllers/rover/rover.py','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa',NULL,'{"python": "3.11.7", "webots_mcp": "0.1.0"}',1,'{}',1700000000.0,1700000000.0,1700000000.0,1700000000.0,0.0,NULL,0,0,NULL,1700000060.0,'replaced','00000000-0000-4000-8000-000000000001','p',NULL,NULL,'real_time',3,NULL);
CREATE TABLE signal (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	robot_id INTEGER NOT NULL,
	name TEXT NOT NULL /* dotted: pose.0, sensors.front, lidar.min */,
	kind TEXT NOT NULL /* num, bool, text, angle (radians), null (no value yet) */,
	unit TEXT /* where the name tells it */,
	path TEXT NOT NULL /* for json_extract(state.data, path) */,
	reduce TEXT /* count, min, max, mean or argmin of the long array at path */,
	first_seen_wall_time_s FLOAT NOT NULL,
	last_seen_wall_time_s FLOAT NOT NULL,
	rows INTEGER DEFAULT 0 NOT NULL /* state rows that held it, up to the watermark */,
	null_rows INTEGER DEFAULT 0 NOT NULL /* of them without a value */,
	odd_rows INTEGER DEFAULT 0 NOT NULL /* of them with a value that JSON cannot hold (nan, inf, ...) */,
	min FLOAT,
	max FLOAT,
	CONSTRAINT fk_signal_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE,
	CONSTRAINT uq_signal_robot_id UNIQUE (robot_id, name)
);
INSERT INTO "signal" VALUES(1,1,'pose.0','num',NULL,'$.pose[0]',NULL,1700000000.0,1700000044.5,70,0,0,0.0,5.9);
INSERT INTO "signal" VALUES(2,1,'pose.1','num',NULL,'$.pose[1]',NULL,1700000000.0,1700000044.5,70,0,0,0.0,0.0);
INSERT INTO "signal" VALUES(3,1,'pose.2','angle','rad','$.pose[2]',NULL,1700000000.0,1700000044.5,70,0,0,0.0,0.0);
INSERT INTO "signal" VALUES(4,1,'mode','text',NULL,'$.mode',NULL,1700000000.0,1700000044.5,70,0,0,NULL,NULL);
INSERT INTO "signal" VALUES(5,1,'front','num',NULL,'$.front',NULL,1700000000.0,1700000044.5,70,1,1,1.0,1.0);
CREATE TABLE state (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	run_id INTEGER NOT NULL,
	sim_time_s FLOAT NOT NULL,
	wall_time_s FLOAT NOT NULL,
	data TEXT NOT NULL /* JSON object */,
	odd TEXT /* JSON object: path of a replaced value to what it was (nan, inf, ...) */,
	CONSTRAINT fk_state_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
INSERT INTO "state" VALUES(31,1,15.0,1700000015.0,'{"pose": [3.0, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(32,1,15.5,1700000015.5,'{"pose": [3.1, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(33,1,16.0,1700000016.0,'{"pose": [3.2, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(34,1,16.5,1700000016.5,'{"pose": [3.3, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(35,1,17.0,1700000017.0,'{"pose": [3.4, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(36,1,17.5,1700000017.5,'{"pose": [3.5, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(37,1,18.0,1700000018.0,'{"pose": [3.6, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(38,1,18.5,1700000018.5,'{"pose": [3.7, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(39,1,19.0,1700000019.0,'{"pose": [3.8, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(40,1,19.5,1700000019.5,'{"pose": [3.9, 0.0, 0.0], "mode": "cruise", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(41,1,20.0,1700000020.0,'{"pose": [4.0, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(42,1,20.5,1700000020.5,'{"pose": [4.1, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(43,1,21.0,1700000021.0,'{"pose": [4.2, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(44,1,21.5,1700000021.5,'{"pose": [4.3, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(45,1,22.0,1700000022.0,'{"pose": [4.4, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(46,1,22.5,1700000022.5,'{"pose": [4.5, 0.0, 0.0], "mode": "turn", "front": null}','{"front": "nan"}');
INSERT INTO "state" VALUES(47,1,23.0,1700000023.0,'{"pose": [4.6, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(48,1,23.5,1700000023.5,'{"pose": [4.7, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(49,1,24.0,1700000024.0,'{"pose": [4.8, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(50,1,24.5,1700000024.5,'{"pose": [4.9, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(51,1,25.0,1700000025.0,'{"pose": [5.0, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(52,1,25.5,1700000025.5,'{"pose": [5.1, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(53,1,26.0,1700000026.0,'{"pose": [5.2, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(54,1,26.5,1700000026.5,'{"pose": [5.3, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(55,1,27.0,1700000027.0,'{"pose": [5.4, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(56,1,27.5,1700000027.5,'{"pose": [5.5, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(57,1,28.0,1700000028.0,'{"pose": [5.6, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(58,1,28.5,1700000028.5,'{"pose": [5.7, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(59,1,29.0,1700000029.0,'{"pose": [5.8, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(60,1,29.5,1700000029.5,'{"pose": [5.9, 0.0, 0.0], "mode": "turn", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(61,2,0.0,1700000040.0,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(62,2,0.5,1700000040.5,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(63,2,1.0,1700000041.0,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(64,2,1.5,1700000041.5,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(65,2,2.0,1700000042.0,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(66,2,2.5,1700000042.5,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(67,2,3.0,1700000043.0,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(68,2,3.5,1700000043.5,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(69,2,4.0,1700000044.0,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
INSERT INTO "state" VALUES(70,2,4.5,1700000044.5,'{"pose": [0.0, 0.0, 0.0], "mode": "wait", "front": 1.0}',NULL);
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
	CONSTRAINT fk_trial_trial_set_id FOREIGN KEY(trial_set_id) REFERENCES trial_set (id) ON DELETE CASCADE,
	CONSTRAINT fk_trial_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE SET NULL,
	CONSTRAINT uq_trial_trial_set_id UNIQUE (trial_set_id, number)
);
INSERT INTO "trial" VALUES(1,1,'00000000-0000-4000-8000-000000000007',1,'{"kp": 2.0}','done',2,5.0,'for_s',4.5,NULL,NULL,NULL,NULL,NULL);
CREATE TABLE trial_set (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	uuid TEXT NOT NULL /* random (version 4); names the row among those of all machines */,
	"plan" TEXT NOT NULL /* JSON object */,
	created_wall_time_s FLOAT NOT NULL,
	host TEXT /* of the process at work */,
	pid INTEGER,
	process TEXT /* which process of that pid; null where the system does not tell */
, robot_id INTEGER /* in whose simulation the trials run; null: each in one of its own */ CONSTRAINT fk_trial_set_robot_id REFERENCES robot (id) ON DELETE SET NULL, session_id INTEGER /* of the controller that was tried */ CONSTRAINT fk_trial_set_session_id REFERENCES session (id) ON DELETE SET NULL, former_values TEXT /* JSON object: its parameters before, until they are set back */ NULL, stop_reason TEXT /* why it does not go on although trials wait */ NULL);
INSERT INTO "trial_set" VALUES(1,'00000000-0000-4000-8000-000000000006','{"parameters": {"kp": [1.0, 2.0]}}',1700000030.0,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
CREATE TABLE watermark (
	name TEXT NOT NULL /* rollup */,
	state_id INTEGER NOT NULL,
	PRIMARY KEY (name)
);
INSERT INTO "watermark" VALUES('rollup',70);
CREATE INDEX ix_session_robot_id_id ON session (robot_id, id);
CREATE INDEX ix_command_claimed ON command (robot_id, id) WHERE status = 'claimed';
CREATE INDEX ix_command_pending ON command (robot_id, id) WHERE status = 'pending';
CREATE INDEX ix_run_robot_id_id ON run (robot_id, id);
CREATE INDEX ix_run_session_id ON run (session_id);
CREATE INDEX ix_event_run_id_sim_time_s ON event (run_id, sim_time_s);
CREATE INDEX ix_image_run_id_sim_time_s ON image (run_id, sim_time_s);
CREATE INDEX ix_log_run_id_sim_time_s ON log (run_id, sim_time_s);
CREATE INDEX ix_state_run_id_sim_time_s ON state (run_id, sim_time_s);
CREATE UNIQUE INDEX ix_session_uuid ON session (uuid);
CREATE UNIQUE INDEX ix_run_uuid ON run (uuid);
CREATE INDEX ix_command_session_id ON command (session_id);
CREATE INDEX ix_breakpoint_robot_id ON breakpoint (robot_id);
CREATE INDEX ix_breakpoint_session_id ON breakpoint (session_id);
CREATE INDEX ix_parameter_value_run_id_name_id ON parameter_value (run_id, name, id);
CREATE UNIQUE INDEX ix_trial_set_uuid ON trial_set (uuid);
CREATE INDEX ix_trial_run_id ON trial (run_id);
CREATE UNIQUE INDEX ix_trial_uuid ON trial (uuid);
CREATE INDEX ix_trial_set_robot_id ON trial_set (robot_id);
CREATE INDEX ix_trial_set_session_id ON trial_set (session_id);
CREATE INDEX ix_kept_stretch_run_id_start_sim_time_s ON kept_stretch (run_id, start_sim_time_s);
CREATE UNIQUE INDEX ix_kept_stretch_uuid ON kept_stretch (uuid);
CREATE INDEX ix_kept_state_run_id_sim_time_s ON kept_state (run_id, sim_time_s);
DELETE FROM "sqlite_sequence";
INSERT INTO "sqlite_sequence" VALUES('robot',1);
INSERT INTO "sqlite_sequence" VALUES('session',1);
INSERT INTO "sqlite_sequence" VALUES('run',2);
INSERT INTO "sqlite_sequence" VALUES('state',70);
INSERT INTO "sqlite_sequence" VALUES('log',1);
INSERT INTO "sqlite_sequence" VALUES('event',2);
INSERT INTO "sqlite_sequence" VALUES('image',1);
INSERT INTO "sqlite_sequence" VALUES('kept_stretch',1);
INSERT INTO "sqlite_sequence" VALUES('kept_state',1);
INSERT INTO "sqlite_sequence" VALUES('breakpoint',1);
INSERT INTO "sqlite_sequence" VALUES('parameter',1);
INSERT INTO "sqlite_sequence" VALUES('command',1);
INSERT INTO "sqlite_sequence" VALUES('parameter_value',1);
INSERT INTO "sqlite_sequence" VALUES('trial_set',1);
INSERT INTO "sqlite_sequence" VALUES('trial',1);
INSERT INTO "sqlite_sequence" VALUES('signal',5);
