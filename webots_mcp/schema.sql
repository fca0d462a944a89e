PRAGMA application_id = 1463962947;
PRAGMA user_version = 2;
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
CREATE TABLE lease (
	name TEXT NOT NULL, 
	holder TEXT NOT NULL, 
	until_wall_time_s FLOAT NOT NULL, 
	PRIMARY KEY (name)
);
CREATE TABLE robot (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	name TEXT NOT NULL /* Robot.name; #2 is appended where two live at once */, 
	kind TEXT NOT NULL /* Robot or Supervisor */, 
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
	hold TEXT /* paused or stepping while the bridge holds the loop */, 
	rows_waiting INTEGER DEFAULT 0 NOT NULL /* rows not yet written, in the controller's memory */, 
	rows_dropped INTEGER DEFAULT 0 NOT NULL /* rows that could never be written */, 
	last_error TEXT /* newest thing that could not be recorded, and why */, 
	ended_wall_time_s FLOAT, 
	end_reason TEXT /* finished, reload, crashed, replaced */, 
	CONSTRAINT fk_session_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE
);
CREATE INDEX ix_session_robot_id_id ON session (robot_id, id);
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
CREATE INDEX ix_command_claimed ON command (robot_id, id) WHERE status = 'claimed';
CREATE INDEX ix_command_pending ON command (robot_id, id) WHERE status = 'pending';
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
	note TEXT, 
	CONSTRAINT fk_run_robot_id FOREIGN KEY(robot_id) REFERENCES robot (id) ON DELETE CASCADE, 
	CONSTRAINT fk_run_session_id FOREIGN KEY(session_id) REFERENCES session (id) ON DELETE CASCADE
);
CREATE INDEX ix_run_robot_id_id ON run (robot_id, id);
CREATE INDEX ix_run_session_id ON run (session_id);
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
CREATE INDEX ix_image_run_id_sim_time_s ON image (run_id, sim_time_s);
CREATE TABLE log (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	level TEXT NOT NULL /* debug, info, warning, error */, 
	source TEXT NOT NULL /* controller or bridge */, 
	message TEXT NOT NULL, 
	CONSTRAINT fk_log_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_log_run_id_sim_time_s ON log (run_id, sim_time_s);
CREATE TABLE state (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	run_id INTEGER NOT NULL, 
	sim_time_s FLOAT NOT NULL, 
	wall_time_s FLOAT NOT NULL, 
	data TEXT NOT NULL /* JSON object */, 
	odd TEXT /* JSON object: path of a replaced value to what it was (nan, inf, ...) */, 
	CONSTRAINT fk_state_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
);
CREATE INDEX ix_state_run_id_sim_time_s ON state (run_id, sim_time_s);
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
	cosines FLOAT /* angles only: sum of cosines */, 
	PRIMARY KEY (run_id, signal_id, bucket), 
	CONSTRAINT fk_rollup_run_id FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE CASCADE
)
 WITHOUT ROWID;
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
CREATE TABLE watermark (
	name TEXT NOT NULL /* rollup */, 
	state_id INTEGER NOT NULL, 
	PRIMARY KEY (name)
);
INSERT INTO alembic_version (version_num) VALUES ('0002');
