"""The inputs of a tab: what to show, which signals, what a controller's parameters are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from bokeh.layouts import column
from bokeh.models import Button, CheckboxGroup, Column, Div, NumericInput, Row, Select, TextInput
from bokeh.models import Checkbox as Switch

from webots_mcp.naming import spelled_out
from webots_mcp.parameter import Value
from webots_mcp.plugins.page.style import STATUS, sheet
from webots_mcp.plugins.page.tab_data import Look, Surroundings, run_title
from webots_mcp.webots.orders import Order

NEWEST: Final = "newest"
NONE: Final = "none"
_WINDOWS: Final = (("10", "last 10 s"), ("60", "last 60 s"), ("600", "last 10 min"), ("", "all"))
_ABOVE: Final = "(top)"


class SignalTree:
    """Signals to choose from, those of a branch below its name.

    Args:
        chosen: Is told the names, in the order of the tree, when somebody has chosen.
    """

    def __init__(self, chosen: Callable[[tuple[str, ...]], None]) -> None:
        self._chosen = chosen
        self._names: tuple[str, ...] = ()
        self._groups: dict[CheckboxGroup, list[str]] = {}
        self._is_told = False
        self.layout: Column = column(name="signals", sizing_mode="stretch_width")

    def offer(self, names: tuple[str, ...]) -> None:
        """Show these names; what is chosen stays chosen."""
        if names == self._names:
            return
        chosen, self._names = self.names, names
        self._groups = {}
        children: list[Any] = []
        for branch, below in _by_branch(names).items():
            labels = [name if branch == _ABOVE else name[len(branch) + 1 :] for name in below]
            group = CheckboxGroup(labels=list(map(spelled_out, labels)), margin=(0, 0, 4, 8))
            group.on_change("active", self._on_change)
            self._groups[group] = below
            if branch != _ABOVE:
                children.append(
                    Div(text=spelled_out(branch), render_as_text=True, margin=(2, 0, 0, 0))
                )
            children.append(group)
        self.layout.children = children
        self.choose(chosen)

    @property
    def names(self) -> tuple[str, ...]:
        """Those that are chosen."""
        return tuple(
            below[index] for group, below in self._groups.items() for index in sorted(group.active)
        )

    def choose(self, names: Sequence[str]) -> None:
        """Choose these without telling anybody."""
        self._is_told = True
        for group, below in self._groups.items():
            group.active = [index for index, name in enumerate(below) if name in names]
        self._is_told = False

    def _on_change(self, _name: str, _old: object, _new: object) -> None:
        if not self._is_told:
            self._chosen(self.names)


def _by_branch(names: Sequence[str]) -> dict[str, list[str]]:
    """Names below the branch that they share with others; those that are alone come first."""
    branches: dict[str, list[str]] = {}
    for name in names:
        branches.setdefault(name.partition(".")[0], []).append(name)
    found: dict[str, list[str]] = {_ABOVE: []}
    for branch, below in branches.items():
        if len(below) > 1:
            found[branch] = below
        else:
            found[_ABOVE] += below
    return {branch: below for branch, below in found.items() if below}


class Selectors:
    """Which robot, which run, which beside it, and how much of it.

    Args:
        changed: Is told when somebody has chosen.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self.robot = Select(title="robot", width=130, name="robot")
        self.run = Select(title="run", width=250, name="run", options=[(NEWEST, "newest run")])
        self.beside = Select(
            title="over it", width=250, name="beside", options=[(NONE, "no other")]
        )
        self.window = Select(
            title="time", width=110, name="window", options=list(_WINDOWS), value="60"
        )
        self.run.value, self.beside.value = NEWEST, NONE
        self._changed = changed
        self._is_told = False
        for each in self.all:
            each.on_change("value", self._on_change)

    def _on_change(self, _name: str, _old: object, _new: object) -> None:
        if not self._is_told:
            self._changed()

    @property
    def all(self) -> tuple[Select, ...]:
        """In the order in which they stand."""
        return self.robot, self.run, self.beside, self.window

    def offer(self, shown: Look, around: Surroundings) -> None:
        """Show what there is to choose from; what is chosen and gone is chosen no more."""
        runs = [(str(run.run_id), run_title(run)) for run in around.runs]
        self._is_told = True
        _offer(self.robot, [(name, spelled_out(name)) for name in around.robots], shown.robot)
        _offer(self.run, [(NEWEST, "newest run"), *runs], NEWEST)
        _offer(self.beside, [(NONE, "no other"), *runs], NONE)
        self._is_told = False


def _offer(select: Any, options: list[tuple[str, str]], fallback: str) -> None:
    if list(select.options) != options:
        select.options = options
    if select.value not in [value for value, _ in options]:
        select.value = fallback


class Parameters:
    """What a controller lets be set.

    Args:
        changed: Is told a name and a value that somebody has typed; None where nothing may be set.
    """

    def __init__(self, changed: Callable[[str, Value], None] | None) -> None:
        self._changed = changed
        self._inputs: dict[str, Any] = {}
        self._told: dict[str, Any] = {}
        self.layout: Column = column(name="parameters", sizing_mode="stretch_width")

    def show(self, parameters: Sequence[dict[str, Any]], *, settable: bool) -> None:
        """Show these values; an input that somebody has changed keeps what was typed until then."""
        form = {each["name"]: _title(each) for each in parameters}
        if [*form.values()] != [_shown_title(each) for each in self._inputs.values()]:
            self._inputs = {each["name"]: self._input(each) for each in parameters}
            heading = Div(text="<h2>Parameters</h2>", stylesheets=sheet(STATUS))
            self.layout.children = [heading, *self._inputs.values()] if parameters else []
            self._told = {}
        for each in parameters:
            shown = self._inputs[each["name"]]
            shown.disabled = self._changed is None or not settable
            if self._told.get(each["name"]) != each["value"]:
                self.set(each["name"], each["value"])

    def set(self, name: str, value: Any) -> None:
        """Show that it has this value."""
        shown = self._inputs[name]
        self._told[name] = value
        if isinstance(shown, Switch):
            shown.active = bool(value)
        else:
            shown.value = str(value) if isinstance(shown, (Select, TextInput)) else value

    def put_back(self) -> None:
        """Show what the controller has, where something else was typed and refused."""
        for name, value in dict(self._told).items():
            self.set(name, value)

    def _input(self, parameter: dict[str, Any]) -> Any:
        name, value, title = parameter["name"], parameter["default"], _title(parameter)
        choices = parameter["choices"]
        if choices:
            made: Any = Select(title=title, options=[str(each) for each in choices])
        elif isinstance(value, bool):
            made = Switch(label=title)
        elif isinstance(value, (int, float)):
            mode = "int" if isinstance(value, int) else "float"
            made = NumericInput(title=title, mode=mode)
        else:
            made = TextInput(title=title)
        made.update(name=f"parameter {name}", sizing_mode="stretch_width")

        def typed(_attribute: str, _old: object, new: Any) -> None:
            self._typed(name, new, choices)

        made.on_change("active" if isinstance(made, Switch) else "value", typed)
        return made

    def _typed(self, name: str, value: Any, choices: Sequence[Value] | None) -> None:
        value = next((each for each in choices or () if str(each) == value), value)
        if self._changed is not None and value is not None and value != self._told.get(name):
            self._changed(name, value)


def _shown_title(made: Any) -> str:
    return made.label if isinstance(made, Switch) else made.title


def _title(parameter: dict[str, Any]) -> str:
    """Its name, unit and bounds."""
    low, high = parameter["low"], parameter["high"]
    unit = f" [{parameter['unit']}]" if parameter["unit"] else ""
    bounds = "" if low is None and high is None else f" ({_bound(low)} to {_bound(high)})"
    return f"{parameter['name']}{unit}{bounds}"


def _bound(value: float | None) -> str:
    return "any" if value is None else f"{value:g}"


def buttons(orders: Sequence[Order], pressed: Callable[[Order], None]) -> Row:
    """One for each order."""
    made: list[Any] = []
    for order in orders:
        button = Button(label=order.capitalize(), name=order, width=70, align="end")
        button.on_click(partial(pressed, order))
        made.append(button)
    return Row(children=made, name="orders", align="end")
