"""The question why nothing works: the checks of `webots-mcp doctor`, answered to a model.

What is wrong comes first; of what passed only the names are shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from webots_mcp.answers.answer_models import (
    DiagnosisAnswer,
)
from webots_mcp.answers.shortening import (
    cut_text,
    tokens_in,
)
from webots_mcp.questions.declaration import READS, question
from webots_mcp.store.recording import RecordingAccess

if TYPE_CHECKING:
    from webots_mcp.setup.doctor import Checked


@dataclass(frozen=True)
class DiagnosisLimits:
    """Limits of an answer.

    Attributes:
        text_characters: Length at which a text is cut.
        tokens: Budget of checks; further checks are only named.
    """

    text_characters: int = 320
    tokens: int = 1_250


_LIMITS: Final = DiagnosisLimits()


@question("Diagnose the set-up", READS, tier="core")
def webots_diagnose_setup(recording: RecordingAccess) -> DiagnosisAnswer:
    """Find out why nothing is recorded, why data is old, or why simulated time stands still.

    Tests each link from Webots and the controller to this server, and says how to fix a broken
    one. It judges the installation, not the robot: for the robot's behaviour use
    webots_check_run.
    """
    from webots_mcp.setup.doctor import diagnose, subject_of, worst

    checked = diagnose(subject_of(recording, "how this server was started"))
    return DiagnosisAnswer(
        verdict=worst([each.finding for each in checked]).verdict,
        failed=_failed(checked) or None,
        not_checked=_by_reason(checked) or None,
        passed=", ".join(each.check.name for each in checked if each.is_well),
    )


def _failed(checked: Sequence[Checked]) -> list[dict[str, str]]:
    """Return what is wrong before what might be."""
    reported: list[dict[str, str]] = []
    left = _LIMITS.tokens
    for verdict in ("wrong", "warning"):
        for check, finding in checked:
            if finding.verdict == verdict:
                head = {"check": check.name, "verdict": verdict}
                texts = {"seen": finding.seen, "fix": finding.fix or ""}
                cut = {
                    name: cut_text(text, _LIMITS.text_characters)
                    for name, text in texts.items()
                    if text
                }
                left -= sum(map(tokens_in, cut.values()))
                reported.append(head | (cut if left > 0 else {}))
    return reported


def _by_reason(checked: Sequence[Checked]) -> dict[str, str]:
    names: dict[str, list[str]] = {}
    for check, finding in checked:
        if finding.verdict == "not checked":
            names.setdefault(cut_text(finding.seen, _LIMITS.text_characters), []).append(check.name)
    return {reason: ", ".join(those) for reason, those in names.items()}
