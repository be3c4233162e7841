"""Read JSON and TOML files into validated models.

If a file is wrong, InputError is raised. Its message is one line, which names the file and the field and says what is wrong. The line ends
with advice for the user, which the caller gives as `again`, such as "Train again."
"""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from refgs.errors import InputError
from refgs.paths import read_text

Number = Annotated[float, Field(strict=True)]
"""Number, which may be NaN or infinite. Neither text nor a boolean is one."""
Finite = Annotated[FiniteFloat, Field(strict=True)]
Vector = tuple[Finite, Finite, Finite]
Matrix = list[list[float]]
"""Numbers of any shape. Text that is a number is one, too."""


class Model(BaseModel):
    """Serve as the base class for files' models, which ignore undeclared fields."""

    model_config = ConfigDict(frozen=True)


M = TypeVar("M", bound=BaseModel)


def read_json(file: Path, model: type[M], again: str) -> M:
    """Read a JSON file into a model. Raises InputError, whose message ends with `again`."""
    return validated(parse_json(read_text(file, again), str(file), again), model, str(file), again)


def read_toml(file: Path, model: type[M], again: str) -> M:
    """Read a TOML file into a model. Raises InputError, whose message ends with `again`."""
    return validated(read_tables(file, again), model, str(file), again)


def read_tables(file: Path, again: str) -> dict[str, Any]:
    """Read a TOML file as nested dicts. Raises InputError, whose message ends with `again`."""
    return parse_toml(read_text(file, again), str(file), again)


def parse_json(text: str, source: str, again: str) -> Any:
    """Parse JSON. Raises InputError, whose message begins with `source` and ends with `again`."""
    return _parsed(json.loads, text, source, "JSON", again)


def parse_toml(text: str, source: str, again: str) -> dict[str, Any]:
    """Parse TOML. Raises InputError, whose message begins with `source` and ends with `again`."""
    return _parsed(tomllib.loads, text, source, "TOML", again)


def _parsed(loads: Callable[[str], Any], text: str, source: str, kind: str, again: str) -> Any:
    try:
        return loads(text)
    except json.JSONDecodeError as error:
        why = f"line {error.lineno}: {error.msg}"
    except RecursionError:
        why = "it is nested too deeply"
    except ValueError as error:  # of TOML; or a number of thousands of digits
        why = str(error)[:200]
    raise InputError(f"{source}: not {kind}: {why}. {again}")


def validated(data: Any, model: type[M], source: str, again: str) -> M:
    """Check data that `json` or `tomllib` returned, and convert it to a model.

    Raises InputError if the data does not fit the model. The message begins with `source` and ends with `again`, advice for the user.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where, field = _place(first, data)
        raise InputError(f"{', '.join([source, *where])}: {field} {_problem(first)}. {again}") from None
    except RecursionError:
        raise InputError(f"{source}: it is nested too deeply. {again}") from None


def _place(error: Any, data: Any) -> tuple[list[str], str]:
    """Return where an error is: ["frame PATH"] or [], and the keys joined by dots."""
    where, keys = [], []
    for part in error["loc"]:
        known = range(len(data)) if isinstance(data, list) else data if isinstance(data, dict) else ()
        if part not in known:
            if error["type"] == "missing":
                keys.append(str(part))
            break  # otherwise it is pydantic's name of a type that was tried
        data = data[part]
        keys.append(str(part))
        if isinstance(data, dict) and isinstance(data.get("file_path"), str):
            where, keys = [f"frame {data['file_path']}"], []
    return where, ".".join(keys)[:200] or "its content"


def _problem(error: Any) -> str:
    if error["type"] == "missing":
        return "is missing"
    if error["type"] == "extra_forbidden":
        return "is not known"
    if error["type"] == "value_error":
        return str(error["ctx"]["error"])
    if error["type"].startswith(("model_", "dict_")):
        return "should be a table of keys and values"
    message = error["msg"]
    start = "Input should be "
    return f"should be {message.removeprefix(start)}" if message.startswith(start) else f"is wrong: {message.lower()}"
