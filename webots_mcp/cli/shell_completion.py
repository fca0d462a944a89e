"""Complete names of robots, runs, signals and kinds in shells, in addition to commands and options.

The script of cyclopts completes commands, options, choices and files. Added lines call `webots-mcp
completion --values KIND` for names in the recording.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.store.recording import RecordingAccess

ValueKind = Literal["robots", "runs", "signals", "kinds"]
_MOST: Final = 500  # names that are offered
_OPTIONS: Final = {
    "robots": ("--robot",),
    "runs": ("--run", "--runs"),
    "signals": ("--signal", "--describe", "--undo"),
    "kinds": ("--kind",),
}
_POSITIONALS: Final = {
    "runs": ("check", "compare", "first-difference", "annotate", "report", "retention"),
    "signals": ("history", "plot", "trends"),
}
_BASH: Final = """
_webots_mcp_values() {
  local cur="${COMP_WORDS[COMP_CWORD]}" prev="${COMP_WORDS[COMP_CWORD-1]}" kind="" IFS=$' \\t\\n'
  case "$prev" in
@options@
  esac
  if [[ -z "$kind" && "$cur" != -* && "$prev" != -* && "$COMP_CWORD" -gt 1 ]]; then
    case "${COMP_WORDS[1]}" in
@positionals@
    esac
  fi
  if [[ -n "$kind" ]]; then
    local -a where=()
    local i
    for ((i=2; i<COMP_CWORD-1; i++)); do
      case "${COMP_WORDS[i]}" in
        --data-dir|--database) where+=("${COMP_WORDS[i]}" "${COMP_WORDS[i+1]}");;
      esac
    done
    IFS=$'\\n'
    COMPREPLY=($(compgen -W "$("${COMP_WORDS[0]}" completion --values "$kind" "${where[@]}" \\
      2>/dev/null)" -- "$cur"))
    [[ ${#COMPREPLY[@]} -gt 0 ]] && return
  fi
  _webots_mcp
}

complete -F _webots_mcp_values webots-mcp
"""
# A file that `compinit` loads is run at the first Tab, which it has to answer.
_ZSH: Final = """
_webots_mcp_values() {
  local cur="${words[CURRENT]}" prev="${words[CURRENT-1]}" kind=""
  case "$prev" in
@options@
  esac
  if [[ -z "$kind" && "$cur" != -* && "$prev" != -* && "$CURRENT" -gt 2 ]]; then
    case "${words[2]}" in
@positionals@
    esac
  fi
  if [[ -n "$kind" ]]; then
    local -a where names
    local i
    for ((i=3; i<CURRENT-1; i++)); do
      case "${words[i]}" in
        --data-dir|--database) where+=("${(Q)words[i]}" "${(Q)words[i+1]}");;
      esac
    done
    names=("${(@f)$("${(Q)words[1]}" completion --values "$kind" "${where[@]}" 2>/dev/null)}")
    names=(${names:#})
    (( $#names )) && compadd -a names && return
  fi
  _cyclopts_webots-mcp "$@"
}

(( $+functions[compdef] )) && compdef _webots_mcp_values webots-mcp
if [[ "${funcstack[1]}" == _cyclopts_webots-mcp ]]; then
  _webots_mcp_values "$@"
fi
"""
_FISH: Final = """
function __webots_mcp_values
  set -l given (commandline -opc)
  set -l where
  for i in (seq 2 (count $given))
    if contains -- $given[$i] --data-dir --database; and test $i -lt (count $given)
      set -a where $given[$i] $given[(math $i + 1)]
    end
  end
  $given[1] completion --values $argv[1] $where 2>/dev/null
end
"""


def with_values(script: str, shell: str) -> str:
    """Return the script of a shell that also completes names of the recording."""
    if shell in ("bash", "zsh"):
        added = _BASH if shell == "bash" else _ZSH
        return script + added.replace("@options@", _cases(_OPTIONS, 4)).replace(
            "@positionals@", _cases(_POSITIONALS, 6)
        )
    if shell == "fish":
        return script + _FISH + "".join(map(_fish_lines, _OPTIONS))
    return script


def _cases(words_by_kind: dict[str, tuple[str, ...]], indent: int) -> str:
    return "\n".join(
        f"{'':{indent}}{'|'.join(words)}) kind={kind};;" for kind, words in words_by_kind.items()
    )


def _fish_lines(kind: str) -> str:
    options = " ".join(f"-l {option.removeprefix('--')}" for option in _OPTIONS[kind])
    values = f"-a '(__webots_mcp_values {kind})'"
    commands = (
        f"complete -c webots-mcp -n '__fish_webots-mcp_using_command {name}' {values}\n"
        for name in _POSITIONALS.get(kind, ())
    )
    return f"complete -c webots-mcp {options} -x {values}\n" + "".join(commands)


def values_of(kind: ValueKind, recording: RecordingAccess) -> list[str]:
    """Return the names of a kind in a recording.

    Raises:
        NoDatabaseError: Nothing is recorded there.
    """
    if kind == "kinds":
        from webots_mcp.judging.detection.event_kinds import kind_names

        return kind_names()
    with recording.reader() as connection:
        return _recorded(kind, connection)[:_MOST]


def _recorded(kind: ValueKind, connection: sqlite3.Connection) -> list[str]:
    if kind == "robots":
        from webots_mcp.store.robots import list_robots

        return [robot.name for robot in list_robots(connection, time.time())]
    if kind == "runs":
        rows = connection.execute("SELECT id FROM run ORDER BY id DESC LIMIT ?", (_MOST,))
        return [str(run_id) for (run_id,) in rows]
    from webots_mcp.store.reading.catalogue import known_signals
    from webots_mcp.store.reading.ranges import Scope, find_range

    return sorted(known_signals(connection, find_range(connection, Scope())))
