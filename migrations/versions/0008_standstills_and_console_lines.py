"""The standstills of 500 s; lines of Webots' console that wait for a run.

The views robot_now and robot_trajectory find positions and modes in names of several words, however
they are joined (`currentPosX`, `pos_x`, `driveMode`), and modes that are whole numbers.

Revision ID: 0008
Revises: 0007
"""

import json
import string

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"

STANDSTILLS = (
    "JSON, at the signal of x: where the robot stood still, and what shows whether it should have "
    "moved; null where that was not looked for"
)
# Merged again, what older versions merged gets it as well, where no row was deleted yet.
MERGE_AGAIN = "UPDATE run SET coarse_end = NULL WHERE purged_rows = 0"

VIEWS = ("robot_now", "robot_trajectory")
# As webots_mcp/naming.py had them; a later change there takes a migration of its own.
IS_NUMBER = "IN ('integer', 'real')"
BRANCHES = ("pose", "position", "pos", "gps", "odometry", "odom", "location")
OWN = (
    *BRANCHES, "m", "cm", "mm", "km", "robot", "rover", "current", "actual", "own", "self",
)  # fmt: skip
ELSEWHERE = json.dumps([
    "accel", "acceleration", "accelerometer", "angular", "axis", "cmd", "command", "compass",
    "error", "force", "gravity", "gyro", "imu", "linear", "magnetometer", "offset", "speed",
    "torque", "twist", "vel", "velocity", "wind", "ball", "blob", "box", "desired",
    "destination", "goal", "image", "item", "marker", "object", "obstacle", "pixel",
    "reference", "setpoint", "target", "waypoint",
])  # fmt: skip
MODES = (("mode", "behaviour", "behavior", "action", "task", "phase"), ("state", "status"))
PAST_OR_FUTURE = json.dumps(["last", "previous", "prev", "old", "next", "desired", "target"])
UNITS = {"mm": 0.001, "cm": 0.01, "km": 1000}
FORMER_UNITS = {"mm": 0.001, "cm": 0.01}
NAME = """replace(replace(replace({}, '"', ''), '[', '.'), ']', '')"""
HEAD_OF_NAME = "length(rtrim({0}, replace({0}, '.', '')))"  # up to the last dot


SMALL = {"GPS": "Gps", "IMU": "Imu"} | {
    letter: f"_{letter.lower()}" for letter in string.ascii_uppercase
}
AT_ONCE = 14  # in one another: older versions of SQLite parse no deeper expressions


def replacing(steps: list[str], columns: str, changed: str, texts: dict[str, str]) -> None:
    """Add steps that replace texts in some columns of the last one, a few of them at a time."""
    pairs = list(texts.items())
    for start in range(0, len(pairs), AT_ONCE):
        told = columns.split()
        for at, name in enumerate(told):
            if name in changed.split():
                for old, new in pairs[start : start + AT_ONCE]:
                    told[at] = f"replace({told[at]}, '{old}', '{new}')"
                told[at] += f" AS {name}"
        steps.append(f"SELECT {', '.join(told)} FROM {step(-1, steps)}")


def step(number: int, steps: list[str]) -> str:
    """The name of a step: of one that follows another, the last one so far."""
    return f"s{number if number >= 0 else len(steps) - 1}"


def with_steps(steps: list[str], query: str) -> str:
    """A query of the last step: one within the other they were too deep for older SQLite."""
    named = ",\n        ".join(
        f"{step(at, steps)} AS MATERIALIZED ({each})" for at, each in enumerate(steps)
    )
    return f"(WITH {named}\n      {query})"


def no_capitals(name: str) -> str:
    """A name in lower case where it is all in capitals, and so no words of several."""
    return f"CASE WHEN {name} = upper({name}) THEN lower({name}) ELSE {name} END"


def has_word(words: str, among: str) -> str:
    """Whether one of the words, each between dots, is one of a JSON array."""
    found = f"instr({words}, '.' || w.value || '.')"
    return f"EXISTS (SELECT 1 FROM json_each('{among}') w WHERE {found})"


def place(other: str) -> str:
    """The coordinate of the first pair beside each other that may be the robot's own place."""
    sizes = " ".join(f"WHEN instr(named, '.{unit}.') THEN {size}" for unit, size in UNITS.items())
    words = "'.' || replace(ltrim({}_key, '_'), '_', '..') || '.' AS {}_key"
    x_words, y_words = (words.format(each, each) for each in "xy")
    last = f"'.' || replace(substr(way, {HEAD_OF_NAME.format('way')} + 1), '_', '.') || '.'"
    branches = json.dumps(BRANCHES)
    columns = "x y name x_key y_key way"
    pairs = f"""SELECT x.value AS x, y.value AS y, {NAME.format("x.fullkey")} AS name,
          {no_capitals("x.key")} AS x_key,
          {no_capitals("y.key")} AS y_key, {NAME.format("x.path")} AS way
        FROM json_tree(j) x JOIN json_tree(j) y ON y.parent = x.parent
        WHERE x.type {IS_NUMBER} AND y.type {IS_NUMBER}
          AND (x.key = 0 AND y.key = 1 OR x.key GLOB '*[xX]*' AND y.key GLOB '*[yY]*')"""
    steps = [pairs]
    replacing(steps, columns, "x_key y_key way", SMALL)
    steps.append(f"""SELECT x, y, name, {x_words}, {y_words},
        '.' || replace(way, '_', '.') || '.' AS way, {last} AS branch FROM {step(-1, steps)}""")
    steps.append(f"SELECT *, way || x_key AS named, x_key AS rest FROM {step(-1, steps)}")
    own = {f".{each}.": "" for each in OWN}
    replacing(steps, "x y name x_key y_key way branch named rest", "rest", own)
    return with_steps(
        steps,
        f"""SELECT {other} * CASE {sizes} ELSE 1 END FROM {step(-1, steps)}
      WHERE NOT {has_word("way", ELSEWHERE)}
        AND (x_key = '.0.' AND y_key = '.1.' AND {has_word("branch", branches)}
          OR rest = '.x.' AND y_key = replace(x_key, '.x.', '.y.'))
      ORDER BY NOT {has_word("branch || x_key", branches)}, name LIMIT 1""",
    )


def former_place(other: str) -> str:
    """As the views had it: what is called x and y, and is no part of something else."""
    path = NAME.format("x.path")
    cases = " ".join(
        f"WHEN {path} || '.' GLOB '*_{unit}.*' THEN {size}" for unit, size in FORMER_UNITS.items()
    )
    return f"""(SELECT {other}.value * CASE {cases} ELSE 1 END
      FROM json_tree(j) x JOIN json_tree(j) y ON y.parent = x.parent
      WHERE x.key = 'x' AND y.key = 'y' AND x.type {IS_NUMBER} AND y.type {IS_NUMBER}
        AND NOT EXISTS (SELECT 1 FROM json_each('{ELSEWHERE}') w WHERE
          instr(replace(lower({path}), '_', '.') || '.', '.' || w.value || '.'))
      ORDER BY NOT EXISTS (SELECT 1 FROM json_each('{json.dumps(BRANCHES)}') w
        WHERE {path} LIKE '%.' || w.value), {path} LIMIT 1)"""


def usual(words: tuple[str, ...], kind: str) -> str:
    """The values at these names, the first of them first."""
    return ",\n    ".join(
        f"CASE WHEN json_type(j, '$.{each}') = '{kind}' THEN json_extract(j, '$.{each}') END"
        for each in words
    )


def mode() -> str:
    """The first text, or else whole number, at one of these names or at one that ends in it.

    One query for all, as each connection that opens a database parses it. A text at a usual name
    comes before all others, and is found without it.
    """
    names = [name for group in MODES for name in group]
    listed = f".{'.'.join(names)}."
    likely = " OR ".join(f"key LIKE '%{each}'" for each in names)
    steps = [
        f"""SELECT value, type, {NAME.format("fullkey")} AS name FROM json_tree(j)
        WHERE type IN ('text', 'integer') AND ({likely})"""
    ]
    last = f"substr(name, {HEAD_OF_NAME.format('name')} + 1)"
    steps.append(f"SELECT *, {last} AS last FROM {step(-1, steps)}")
    steps.append(f"SELECT value, type, name, {no_capitals('last')} AS last FROM {step(-1, steps)}")
    replacing(steps, "value type name last", "last", SMALL)
    steps.append(f"SELECT *, '.' || replace(last, '_', '.') AS words FROM {step(-1, steps)}")
    end = "substr(words, length(rtrim(words, replace(words, '.', ''))))"
    steps.append(f"SELECT *, instr('{listed}', {end} || '.') AS rank FROM {step(-1, steps)}")
    found = with_steps(
        steps,
        f"""SELECT value FROM {step(-1, steps)}
      WHERE rank > 0 AND NOT {has_word("words || '.'", PAST_OR_FUTURE)}
      ORDER BY type = 'integer', rank >= {listed.index(f".{MODES[1][0]}.") + 1},
        CASE WHEN name = '$' || words THEN rank ELSE {len(listed)} END, length(name), name
      LIMIT 1""",
    )
    return f"{usual(MODES[0], 'text')},\n    {found}"


def former_word(words: tuple[str, ...]) -> str:
    """As the views had it: the text at one of these names, or whose last part is one."""
    listed = ", ".join(f"'{each}'" for each in words)
    name = NAME.format("fullkey")
    return f"""{usual(words, "text")},
    (SELECT value FROM json_tree(j) WHERE type = 'text' AND lower(key) IN ({listed})
      ORDER BY length({name}), {name} LIMIT 1)"""


def texts() -> dict[str, str]:
    """What the views had, and what takes its place."""
    former = ",\n    ".join(map(former_word, MODES))
    return {former: mode()} | {former_place(each): place(each) for each in "xy"}


def upgrade() -> None:
    op.add_column("coarse_rollup", sa.Column("standstills", sa.Text(), comment=STANDSTILLS))
    op.execute(MERGE_AGAIN)
    create_console_line()
    if op.get_context().dialect.name == "sqlite":
        for view in VIEWS:
            replace_in_view(view, texts())
        op.execute("PRAGMA user_version = 8")


def replace_in_view(view: str, replaced: dict[str, str]) -> None:
    """Make a view again with other texts in their places."""
    connection = op.get_bind()
    found = f"SELECT sql FROM sqlite_master WHERE type = 'view' AND name = '{view}'"
    sql: str = connection.exec_driver_sql(found).scalar_one()
    connection.exec_driver_sql(f"DROP VIEW {view}")
    for old, new in replaced.items():
        sql = sql.replace(old, new)
    connection.exec_driver_sql(sql)


def create_console_line() -> None:
    said_by = "webots, or console: a controller, not told which; as in log later on"
    op.create_table(
        "console_line",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("instance", sa.Text(), nullable=False, comment="session.instance of who said it"),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("level", sa.Text(), nullable=False),
        sa.Column("source", sa.Text(), nullable=False, comment=said_by),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("logger", sa.Text(), comment="stdout or stderr"),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        for view in VIEWS:
            replace_in_view(view, {new: old for old, new in texts().items()})
        op.execute("PRAGMA user_version = 7")
    op.drop_table("console_line")
    op.drop_column("coarse_rollup", "standstills")
