"""Base of all tables of a scene: strict values, one-line errors, and the reference of their keys.

A leaf that is independent of any scene's keys, which `settings` and `scene` declare.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType, NoneType
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    Protocol,
    Self,
    TypeVar,
    get_args,
    get_origin,
)

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import (
    CoreSchema,
    ErrorDetails,
    PydanticCustomError,
    SchemaValidator,
    core_schema,
)

from remodel_fenicsx.errors import RemodelError, printable, shortened

if TYPE_CHECKING:
    from typing import TypeGuard

    from pydantic.json_schema import JsonSchemaValue

LONGEST_VALUE = 60  # largest number of a value's characters in an error
# Annotation of a tuple: a list of TOML is converted.
IN_A_LIST = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
_MISSING = object()
Faults = Iterator[tuple[str, str, object]]  # rule, key and value; only the first fault is reported
T = TypeVar("T")


class SceneError(RemodelError, ValueError):
    """Invalid input. The text is one line: the dotted key, the value, the allowed values.

    Parameters
    ----------
    message
        The line; characters that a terminal cannot print are replaced.

    Examples
    --------
    >>> from remodel_fenicsx import SceneError, preset_scene
    >>> try:
    ...     preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": "soon"})
    ... except SceneError as error:
    ...     print(error)
    time.end = 'soon': must be a finite number greater than 0, or 'equilibrium'
    """

    def __init__(self, message: str):
        super().__init__(shortened(printable(message)))


class Table(BaseModel):
    """Table of a scene: immutable, without unknown keys, type conversion, NaN and infinity.

    Attributes
    ----------
    further
        Class of the tables that may have any name, in addition to the fields, or None.

    Examples
    --------
    Keys are fields. Their annotations say which values are allowed:

    >>> from remodel_fenicsx.extend import Table
    >>> class Decay(Table):
    ...     rate: float = 0.0
    >>> Decay(rate=0.5).rate
    0.5
    >>> Decay(rate="fast")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: rate = 'fast': must be a finite number
    """

    further: ClassVar[type[Table] | None] = None

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    def _faults(self) -> Faults:
        """Yield rule, key and value of each inconsistency between the table's keys."""
        yield from ()

    @model_validator(mode="after")
    def _has_none(self) -> Self:
        for broken in self._faults():
            raise validation_error(*broken)
        return self

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Return the schema with each key's meaning, without the entries that only scripts need."""
        result = handler(schema)
        table = handler.resolve_ref_schema(result)
        table.pop("title", None)
        table["description"] = meaning(cls)
        for name, entry in table["properties"].items():
            entry.pop("allowed", None)
            entry |= {"description": text} if (text := description(cls, name)) else {}
        if cls.further is not None:
            table["additionalProperties"] = handler(cls.further.__pydantic_core_schema__)
        return result

    if not TYPE_CHECKING:  # the type checker reads the arguments from the fields

        def __init__(self, /, **values):
            try:
                super().__init__(**{name: _of_python(value) for name, value in values.items()})
            except ValidationError as error:
                raise SceneError(one_line(error, type(self))) from None

        # With this flag pydantic validates a table inside a table itself, so that an error keeps
        # its complete dotted key.
        __init__.__pydantic_base_init__ = True


def with_key(name: str, kind: object, **field: Any) -> type[Table]:
    """Create a table class with a key that is a keyword of Python."""
    fields: Any = {name: (kind, Field(**field))}
    return create_model(f"_With_{name}", __base__=Table, **fields)


def _of_python(value: Any) -> object:
    """Return a value with its numpy numbers and arrays, at any depth, as Python's own types."""
    if hasattr(value, "dtype") and hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, dict):
        return {name: _of_python(entry) for name, entry in value.items()}
    return type(value)(map(_of_python, value)) if type(value) in (list, tuple) else value


class Before:
    """Annotation of a field whose values are preprocessed before validation."""

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_before_validator_function(
            functools.partial(self.seen, source), handler(source)
        )

    def seen(self, source: type, value: object) -> object:
        """Return the value that replaces the value of a field of type `source`."""
        raise NotImplementedError


@dataclass(frozen=True)
class OneOf(Before):
    """Annotation of a field whose value is a key of a registry, including keys registered later."""

    registry: Collection[object]
    also: tuple[object, ...] = ()
    removed: Mapping[str, str] | None = None

    @property
    def choices(self) -> list[object]:
        """Allowed values of the field."""
        return [*self.also, *(name for name in self.registry if name not in (self.removed or ()))]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {"enum": self.choices}

    def seen(self, source: type, value: object) -> object:
        """Return the value, or raise if it is not one of the choices."""
        if isinstance(value, str) and value in (self.removed or ()) and value not in self.registry:
            raise validation_error((self.removed or {})[value])
        if value is not None and value not in (*self.also, *self.registry):
            raise ValueError("not registered")
        return value


@dataclass(frozen=True)
class VariantOf(Before):
    """Annotation of a field that is one of several tables, including tables registered later."""

    registry: Mapping[str, type[Table]]
    tag: str

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Return a schema with the keys of all variants, for completion in an editor, and those of
        each."""
        known: dict[str, Any] = {}
        chosen = []
        for tag, table in self.registry.items():
            known |= {
                name: {"description": description(table, name)} for name in table.model_fields
            }
            keys = handler(table.__pydantic_core_schema__)
            chosen.append({"if": {"properties": {self.tag: {"const": tag}}}, "then": keys})
        known[self.tag]["enum"] = list(self.registry)
        return {"type": "object", "properties": known, "required": [self.tag], "allOf": chosen}

    def seen(self, source: type, value: object) -> object:
        """Validate a table as the variant that its tag names."""
        if not isinstance(value, Mapping):
            return value
        name = value[self.tag]
        only = core_schema.tagged_union_schema(
            {name: self.registry[name].__pydantic_core_schema__}, self.tag
        )
        # The locations of its errors have the variant's name after the field's.
        return SchemaValidator(only).validate_python(dict(value))


class PartWithTable(Protocol):
    """Protocol of a part that has a table of keys."""

    @property
    def table(self) -> type[Table]: ...


class OwnNumber(Protocol):
    """Protocol of a part's numerical parameter."""

    default: float
    exclusive_minimum: float | None
    meaning: str


@dataclass(frozen=True)
class KeysOfParts(Before):
    """Annotation of a table with additional keys of the parts that it selects (`parameters`)."""

    registries: Mapping[str, Mapping[str, object]]  # by the key that names the part
    optional: bool = False  # whether the keys may be omitted, as in regions
    tables: Mapping[str, PartWithTable] = MappingProxyType({})  # parts with a table, by its name

    def seen(self, source: type, value: object) -> object:
        """Validate a table with the keys of the parts that it selects."""
        table: type[Table] = source
        if not isinstance(value, Mapping):
            return value
        chosen = {key: value.get(key, table.model_fields[key].default) for key in self.registries}
        parts = [
            self.registries[key].get(name) for key, name in chosen.items() if isinstance(name, str)
        ]
        own = {
            name: number
            for part in parts
            for name, number in getattr(part, "parameters", {}).items()
        }
        own |= {
            name: part.table for name, part in self.tables.items() if name not in table.model_fields
        }
        if not own:
            return value
        wide = extended_table(table, tuple(own.items()), self.optional)
        try:
            return wide.model_validate(dict(value))
        except ValidationError as error:
            raise PydanticCustomError("worded", "{text}", {"text": one_line(error, wide)}) from None


Own = tuple[tuple[str, OwnNumber | type[Table]], ...]


@functools.cache
def extended_table(table: type[Table], own: Own, optional: bool = False) -> type[Table]:
    """Create a table with further numbers and tables, cached so that such scenes compare equal."""
    kind = float | None if optional else float
    fields: dict[str, Any] = {
        name: (
            kind,
            Field(
                default=None if optional else number.default,
                gt=number.exclusive_minimum,
                description=number.meaning,
            ),
        )
        for name, number in own
        if not isinstance(number, type)
    }
    fields |= {name: (inner, inner()) for name, inner in own if isinstance(inner, type)}
    return create_model(
        table.__name__,
        __base__=table,
        __doc__=table.__doc__,
        __module__=table.__module__,
        **fields,
    )


def validation_error(rule: str, key: str = "", value: object = _MISSING) -> PydanticCustomError:
    """Return the error that a validator raises."""
    context = {"rule": rule, "key": key} | ({} if value is _MISSING else {"value": value})
    return PydanticCustomError("fault", "{rule}", context)


def join_names(registry: Mapping[str, T], fits: Callable[[T], object]) -> str:
    """Return the names of the parts of a registry that fit, for an error message."""
    return ", ".join(repr(name) for name, part in registry.items() if fits(part))


def listed(names: Iterable[str], wrong: str, most: int = 24) -> str:
    """Return names for an error message: all, or the `most` that resemble a wrong name."""
    names = list(names)
    if len(names) <= most:
        return ", ".join(names)
    close = ", ".join(difflib.get_close_matches(wrong, names, most, 0.0))
    return f"{close} and {len(names) - most} more"


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number in the range of a float; true and false are not."""
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and abs(value) <= sys.float_info.max
    )


# ---------------------------------------------------------------- errors on one line


def one_line(error: ValidationError, table: type[Table]) -> str:
    """Format the first fault as `key = value: rule`, with the keys of further faults."""
    faults: dict[str, ErrorDetails] = {}  # a key that allows several types has an error for each
    for detail in sorted(
        error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden"
    ):
        faults.setdefault(locate(table, detail["loc"])[0], detail)
    for detail in [detail for detail in faults.values() if detail["type"] == "extra_forbidden"]:
        key, owner, _ = locate(table, detail["loc"])
        # A mistyped key is also reported as missing. The error of the mistyped key is more helpful.
        meant = _nearest_key(key, owner)
        if meant in faults and faults[meant]["type"] == "missing":
            del faults[meant]
    first, *others = faults
    # A list without a valid item is also reported as too short.
    further = listed([key for key in others if not first.startswith(f"{key}[")], first)
    text = _describe(faults[first], table)
    return f"{text} (also wrong or missing: {further})" if further else text


def _describe(detail: ErrorDetails, table: type[Table]) -> str:
    key, owner, field = locate(table, detail["loc"])
    kind, value = detail["type"], detail["input"]
    context = detail.get("ctx", {})
    if kind == "fault":
        key, rule = _joined(key, context["key"]), context["rule"]
        value = context.get("value", value)
        return f"{key}: {rule}" if value is None else f"{key} = {format_value(value)}: {rule}"
    if kind == "worded":
        return _joined(key, context["text"])
    if kind == "extra_forbidden":
        return f"{key} = {format_value(value)}: unknown key; {_suggestion(key, owner, table)}"
    rule = detail["msg"] if field is None else allowed(field)
    return (
        f"{key}: missing; {rule}" if kind == "missing" else f"{key} = {format_value(value)}: {rule}"
    )


def locate(
    table: type[Table], location: tuple[int | str, ...]
) -> tuple[str, type[Table], FieldInfo | None]:
    """Return the dotted key at a location, the table class that owns it, and its field or None."""
    key, owner = "", table
    field = None
    inside: type[Table] | None = table  # the table that owns the next item as a key
    items = list(location)
    while items:
        item = items.pop(0)
        if inside is None:
            if isinstance(item, int) or (
                field is not None and get_origin(field.annotation) is dict
            ):
                key = _joined(key, _step(item))
            if isinstance(item, str):
                break  # the remaining items are pydantic's names of the types of the value
            continue
        key, owner = _joined(key, _step(item)), inside
        field = inside.model_fields.get(str(item))
        if field is None:
            inside = owner.further
            if inside is not None:
                owner, field = inside, FieldInfo.from_annotation(inside)
            continue
        several = {tag: (suffix, kind) for suffix, tag, kind in tables_in(field)}
        suffix, inside = several.get("", ("", None))
        if several and "" not in several and items:
            inside = several[str(items.pop(0))][1]
        elif suffix and items and inside is not None:
            key, owner = _joined(key, _step(items.pop(0))), inside
            field = FieldInfo.from_annotation(inside)
    return key, owner, field


def _step(item: int | str) -> str:
    """Format one component of a dotted key."""
    return f"[{item}]" if isinstance(item, int) else quoted(item)


def _joined(key: str, rest: str) -> str:
    return key + rest if not key or not rest or rest.startswith("[") else f"{key}.{rest}"


def quoted(key: str) -> str:
    """Return a key as TOML writes it: bare, or in quotes."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else format_value(key)


def format_value(value: object) -> str:
    """Format a value as in a scene, on one line, truncated to `LONGEST_VALUE` characters."""
    try:
        text = _toml_text(value)
    except (ValueError, RecursionError):  # an integer with thousands of digits, a recursive list
        text = f"a {type(value).__name__}"
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 3] + "..."


def _toml_text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, BaseModel):
        return _toml_text(value.model_dump(exclude_unset=True))
    if isinstance(value, Mapping):
        return (
            "{" + ", ".join(f"{name} = {_toml_text(entry)}" for name, entry in value.items()) + "}"
        )
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_text(entry) for entry in value) + "]"
    return str(value)


def _nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> list[str]:
    """Return the known name that most resembles a name, as a list of one or none."""
    return difflib.get_close_matches(name, known, n=1, cutoff=cutoff)


def _nearest_key(key: str, owner: type[Table]) -> str:
    """Return the key of the same table that most resembles an unknown key, or an empty string."""
    parent, _, name = key.rpartition(".")
    return "".join(_joined(parent, near) for near in _nearest(name, owner.model_fields))


def _suggestion(key: str, owner: type[Table], table: type[Table]) -> str:
    """Suggest a similar key of this table, else of another table, else list the table's keys."""
    parent, _, name = key.rpartition(".")
    if near := _nearest_key(key, owner):
        return f"did you mean {near}?"
    others = [(other, inner) for other, _, inner in sections(table) if other != parent]
    elsewhere = {
        known: _joined(other, known) for other, inner in others for known in inner.model_fields
    }
    if names := _nearest(name, elsewhere, cutoff=0.8):
        return f"did you mean {elsewhere[names[0]]}?"
    return "allowed: " + ", ".join(_joined(parent, known) for known in owner.model_fields)


# ---------------------------------------------------------------- allowed values of a field


def is_table(annotation: object) -> TypeGuard[type[Table]]:
    """Return whether an annotation is a table class."""
    return isinstance(annotation, type) and issubclass(annotation, Table)


def variant_of_field(field: FieldInfo) -> VariantOf | None:
    """Return the annotation of a field that is one of several tables, or None."""
    return next((entry for entry in field.metadata if isinstance(entry, VariantOf)), None)


def choices(field: FieldInfo) -> list[object]:
    """Return the allowed values of a field that has a finite list of them, else an empty list."""
    if variant := variant_of_field(field):
        return list(variant.registry)
    for entry in field.metadata:
        if isinstance(entry, OneOf):
            return entry.choices
    return list(get_args(_kind(field))) if get_origin(_kind(field)) is Literal else []


def _kind(field: FieldInfo) -> object:
    """Return the annotation of a field without None, if it is one type or None."""
    kinds = [kind for kind in get_args(field.annotation) if kind is not NoneType]
    return (
        kinds[0]
        if get_args(field.annotation) == (*kinds, NoneType) and len(kinds) == 1
        else field.annotation
    )


def allowed(field: FieldInfo) -> str:
    """Describe the values that a field allows, for errors and the reference of keys."""
    if listed := choices(field):
        return f"must be {'one of ' if len(listed) > 1 else ''}" + ", ".join(
            map(format_value, listed)
        )
    if isinstance(field.json_schema_extra, dict):
        return f"must be {field.json_schema_extra['allowed']}"
    if is_table(kind := _kind(field)) or get_origin(kind) is dict:
        fields: dict[str, FieldInfo] = getattr(kind, "model_fields", {})
        required = [name for name, inner in fields.items() if inner.is_required()]
        return "must be a table" + (f" with {', '.join(required)}" if required else "")
    nouns: dict[object, str] = {
        float: "a finite number",
        int: "an integer",
        bool: "true or false",
        str: "a string",
    }
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    bounds = [
        f"{word} {getattr(entry, name)}"
        for entry in field.metadata
        for name, word in words.items()
        if hasattr(entry, name)
    ]
    return " ".join(filter(None, [f"must be {nouns[_kind(field)]}", " and ".join(bounds)]))


def tables_in(field: FieldInfo) -> Iterator[tuple[str, str, type[Table]]]:
    """Yield suffix of the key, variant and class of each table in a field; NAME is a free name."""
    if several := variant_of_field(field):
        yield from (("", tag, kind) for tag, kind in several.registry.items())
        return
    suffix = {dict: ".NAME", tuple: "[]"}.get(get_origin(field.annotation) or str, "")
    yield from (
        (suffix, "", kind)
        for kind in (field.annotation, *get_args(field.annotation))
        if is_table(kind)
    )


def sections(
    table: type[Table], key: str = "", variant: str = ""
) -> Iterator[tuple[str, str, type[Table]]]:
    """Yield dotted key, variant and class of a table and its inner tables; NAME is a free name."""
    yield key, variant, table
    if (kind := table.further) is not None:
        yield from sections(kind, _joined(key, "NAME"))
    for name, field in table.model_fields.items():
        for suffix, tag, inner in tables_in(field):
            yield from sections(inner, _joined(key, name) + suffix, tag)


# ---------------------------------------------------------------- documentation


def description(table: type[Table], name: str) -> str:
    """Return the meaning of a field, on one line."""
    return " ".join((table.model_fields[name].description or "").split())


def meaning(table: type[Table]) -> str:
    """Return a table's docstring without the sections that only scripts need."""
    return re.split(
        r"\n\nIts keyword arguments |\n\n\w+\n---", inspect.cleandoc(table.__doc__ or "")
    )[0]
