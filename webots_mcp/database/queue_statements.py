"""The statements by which a controller claims and answers commands, and others settle the rest.

Each names the status that it expects, so that a command runs at most once; see `database.queue`.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

from typing import Final

# An indexed read takes no lock. An UPDATE takes the write lock even where it matches nothing, so
# it is made only after this has found a command. The texts are read as bytes: one that is not
# UTF-8 would fail the statement after it claimed the command.
PEEK: Final = (
    "SELECT 1 FROM command WHERE robot_id = ? AND status = 'pending' "
    "AND expires_wall_time_s > ? LIMIT 1"
)
# A session that was judged dead although it lives may have a successor: commands are for that one.
_SUCCESSOR: Final = (
    "FROM session s WHERE s.robot_id = :robot AND s.id > :session AND s.ended_wall_time_s IS NULL"
)
CLAIM: Final = (
    "UPDATE command SET status = 'claimed', session_id = :session, claimed_wall_time_s = :now, "
    "claimed_sim_time_s = :sim_time WHERE status = 'pending' AND id = (SELECT id FROM command "
    "WHERE robot_id = :robot AND status = 'pending' AND expires_wall_time_s > :now "
    f"ORDER BY id LIMIT 1) AND NOT EXISTS (SELECT 1 {_SUCCESSOR}) "
    "RETURNING id, CAST(action AS BLOB), CAST(params AS BLOB), CAST(requested_by AS BLOB)"
)
SUCCESSOR_PID: Final = f"SELECT s.pid {_SUCCESSOR} LIMIT 1"
# Commands are claimed in the order of their ids. One row always.
CLAIMED_SINCE: Final = (
    "SELECT (SELECT max(id) FROM command WHERE session_id = ? AND status = 'claimed' AND id > ?)"
)
_OF_CLAIMER: Final = "WHERE id = :command AND status = 'claimed' AND session_id = :session"
ISSUE: Final = f"UPDATE command SET issued_wall_time_s = :now {_OF_CLAIMER}"
FINISH: Final = (
    "UPDATE command SET status = :status, finished_wall_time_s = :now, "
    f"finished_sim_time_s = :sim_time, result = :result, error = :error {_OF_CLAIMER}"
)
# The process that asked for the reload is gone; that this one runs is the proof that it worked.
CONFIRM_RELOAD: Final = (
    "UPDATE command SET status = 'done', finished_wall_time_s = :now, "
    "finished_sim_time_s = :sim_time, result = json_object('run_id', :run, 'mode', :mode, "
    "'why', 'a reload keeps the mode') "
    "WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) AND action = 'reload' "
    "AND status = 'claimed' AND issued_wall_time_s IS NOT NULL"
)
EXPIRE: Final = (
    "UPDATE command SET status = 'expired', finished_wall_time_s = :now, "
    "error = 'no controller claimed it in time; it will never run' "
    "WHERE status = 'pending' AND expires_wall_time_s <= :now"
)
CLAIMED_BY_ENDED: Final = (
    "SELECT c.id, c.issued_wall_time_s, s.extern, s.uuid FROM command c "
    "LEFT JOIN session s ON s.id = c.session_id "
    "WHERE c.status = 'claimed' AND (s.id IS NULL OR s.ended_wall_time_s IS NOT NULL)"
)
LOSE: Final = (
    "UPDATE command SET status = 'lost', finished_wall_time_s = :now, error = :why "
    "WHERE id = :id AND status = 'claimed'"
)
