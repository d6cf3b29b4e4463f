"""What all tables of a scene share: strict values, errors of one line, and the reference of their keys.

A leaf: it knows no key of any scene. `parameters` and `scene` declare the keys.
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
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, TypeVar, get_args, get_origin

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
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, SchemaValidator, core_schema

from remodel_fenicsx.errors import RemodelError, printable, shortened

if TYPE_CHECKING:
    from typing import TypeGuard

    from pydantic.json_schema import JsonSchemaValue

LONGEST_VALUE = 60  # characters of a value in an error
# annotation of a tuple: what is a list in TOML becomes one
IN_A_LIST = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
_MISSING = object()
Faults = Iterator[tuple[str, str, object]]  # what is allowed, a key, and its value; the first is told
T = TypeVar("T")


class SceneError(RemodelError, ValueError):
    """Bad input. Its text is one line: the dotted key, the value, what is allowed.

    Parameters
    ----------
    message
        The line; what no terminal can show is replaced.

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
    """A table of a scene: immutable, no unknown keys, no conversion between types, no NaN and no infinity.

    Attributes
    ----------
    further
        Class of tables that may be there under any name beside the fields; None: there are none.

    Examples
    --------
    A shape's keys, or those of what remodels, are fields with what is allowed:

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
        """What does not fit together in its keys: what is allowed, the key and its value."""
        yield from ()

    @model_validator(mode="after")
    def _has_none(self) -> Self:
        for broken in self._faults():
            raise fault(*broken)
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """With the meaning of each key, and without what scripts alone need."""
        found = handler(schema)
        table = handler.resolve_ref_schema(found)
        table.pop("title", None)
        table["description"] = meaning(cls)
        for name, entry in table["properties"].items():
            entry.pop("allowed", None)
            entry |= {"description": text} if (text := description(cls, name)) else {}
        if cls.further is not None:
            table["additionalProperties"] = handler(cls.further.__pydantic_core_schema__)
        return found

    if not TYPE_CHECKING:  # the type checker reads the arguments from the fields

        def __init__(self, /, **values):
            try:
                super().__init__(**{name: _of_python(value) for name, value in values.items()})
            except ValidationError as error:
                raise SceneError(one_line(error, type(self))) from None

        # A table inside a table is then validated by pydantic directly, so that an error keeps its whole dotted key.
        __init__.__pydantic_base_init__ = True


def with_key(name: str, kind: object, **field: Any) -> type[Table]:
    """A class of tables with a key that is a word of Python."""
    fields: Any = {name: (kind, Field(**field))}
    return create_model(f"_With_{name}", __base__=Table, **fields)


def _of_python(value: Any) -> object:
    """A value with numpy's numbers and arrays, at any depth, as Python's own."""
    if hasattr(value, "dtype") and hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, dict):
        return {name: _of_python(entry) for name, entry in value.items()}
    return type(value)(map(_of_python, value)) if type(value) in (list, tuple) else value


class Before:
    """An annotation of a field whose values are looked at first."""

    def __get_pydantic_core_schema__(self, source: type, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(functools.partial(self.seen, source), handler(source))

    def seen(self, source: type, value: object) -> object:
        """The value to take in place of one of a field of this type."""
        raise NotImplementedError


@dataclass(frozen=True)
class OneOf(Before):
    """Annotation of a field whose value is one of a registry's keys, those registered later included."""

    registry: Collection[object]
    also: tuple[object, ...] = ()
    removed: Mapping[str, str] | None = None

    @property
    def choices(self) -> list[object]:
        """All that is allowed."""
        return [*self.also, *(name for name in self.registry if name not in (self.removed or ()))]

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"enum": self.choices}

    def seen(self, source: type, value: object) -> object:
        """The value, if it is one of those."""
        if isinstance(value, str) and value in (self.removed or ()) and value not in self.registry:
            raise fault((self.removed or {})[value])
        if value is not None and value not in (*self.also, *self.registry):
            raise ValueError("not registered")
        return value


@dataclass(frozen=True)
class VariantOf(Before):
    """Annotation of a field that is one of several tables, those registered later included."""

    registry: Mapping[str, type[Table]]
    tag: str

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The keys of any variant, which an editor completes, and those that each has."""
        known: dict[str, Any] = {}
        chosen = []
        for tag, table in self.registry.items():
            known |= {name: {"description": description(table, name)} for name in table.model_fields}
            keys = handler(table.__pydantic_core_schema__)
            chosen.append({"if": {"properties": {self.tag: {"const": tag}}}, "then": keys})
        known[self.tag]["enum"] = list(self.registry)
        return {"type": "object", "properties": known, "required": [self.tag], "allOf": chosen}

    def seen(self, source: type, value: object) -> object:
        """The table of the variant that a table names."""
        if not isinstance(value, Mapping):
            return value
        name = value[self.tag]
        only = core_schema.tagged_union_schema({name: self.registry[name].__pydantic_core_schema__}, self.tag)
        return SchemaValidator(only).validate_python(dict(value))  # its faults name the variant after the field


class PartWithTable(Protocol):
    """A part that brings a table."""

    @property
    def table(self) -> type[Table]: ...


class OwnNumber(Protocol):
    """A number that a part brings."""

    default: float
    above: float | None
    meaning: str


@dataclass(frozen=True)
class KeysOfParts(Before):
    """Annotation of a field that is a table: with the keys too that the parts chosen in it bring (`parameters`)."""

    registries: Mapping[str, Mapping[str, object]]  # by the key that names the part
    optional: bool = False  # whether the keys may be left out, as those of regions
    tables: Mapping[str, PartWithTable] = MappingProxyType({})  # parts that bring a table of their name

    def seen(self, source: type, value: object) -> object:
        """The table with the keys of its parts."""
        table: type[Table] = source
        if not isinstance(value, Mapping):
            return value
        chosen = {key: value.get(key, table.model_fields[key].default) for key in self.registries}
        parts = [self.registries[key].get(name) for key, name in chosen.items() if isinstance(name, str)]
        own = {name: number for part in parts for name, number in getattr(part, "parameters", {}).items()}
        own |= {name: part.table for name, part in self.tables.items() if name not in table.model_fields}
        if not own:
            return value
        wide = _widened(table, tuple(own.items()), self.optional)
        try:
            return wide.model_validate(dict(value))
        except ValidationError as error:
            raise PydanticCustomError("worded", "{text}", {"text": one_line(error, wide)}) from None


Own = tuple[tuple[str, OwnNumber | type[Table]], ...]


@functools.cache
def _widened(table: type[Table], own: Own, optional: bool) -> type[Table]:
    """A table with further numbers and tables: one class, so that scenes with them can be equal."""
    kind = float | None if optional else float
    fields: dict[str, Any] = {
        name: (kind, Field(default=None if optional else number.default, gt=number.above, description=number.meaning))
        for name, number in own
        if not isinstance(number, type)
    }
    fields |= {name: (inner, inner()) for name, inner in own if isinstance(inner, type)}
    return create_model(table.__name__, __base__=table, __doc__=table.__doc__, **fields)


def fault(rule: str, key: str = "", value: object = _MISSING) -> PydanticCustomError:
    """Error to raise in a validator."""
    context = {"rule": rule, "key": key} | ({} if value is _MISSING else {"value": value})
    return PydanticCustomError("fault", "{rule}", context)


def named(registry: Mapping[str, T], fits: Callable[[T], object]) -> str:
    """The names in a registry of the parts that fit, for an error."""
    return ", ".join(repr(name) for name, part in registry.items() if fits(part))


def listed(names: Iterable[str], wrong: str, most: int = 24) -> str:
    """Names for an error; of many those that are most like a wrong one."""
    names = list(names)
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(difflib.get_close_matches(wrong, names, most, 0.0))} and {len(names) - most} more"


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a finite number that a float can hold; true and false are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


# ---------------------------------------------------------------- one line for an error


def one_line(error: ValidationError, table: type[Table]) -> str:
    """`key = value: what is allowed` of the first fault, with the number of further ones."""
    faults: dict[str, ErrorDetails] = {}  # where several kinds of values are allowed there is one for each kind
    for detail in sorted(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden"):
        faults.setdefault(locate(table, detail["loc"])[0], detail)
    for detail in [detail for detail in faults.values() if detail["type"] == "extra_forbidden"]:
        key, owner, _ = locate(table, detail["loc"])
        meant = _nearest_key(key, owner)  # a mistyped key is also a missing key: the mistyped one says more
        if meant in faults and faults[meant]["type"] == "missing":
            del faults[meant]
    text, more = _describe(next(iter(faults.values())), table), len(faults) - 1
    return f"{text} (and {more} more fault{'s' if more > 1 else ''})" if more else text


def _describe(detail: ErrorDetails, table: type[Table]) -> str:
    key, owner, field = locate(table, detail["loc"])
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind == "fault":
        key, rule = _joined(key, context["key"]), context["rule"]
        value = context.get("value", value)
        return f"{key}: {rule}" if value is None else f"{key} = {shown(value)}: {rule}"
    if kind == "worded":
        return _joined(key, context["text"])
    if kind == "extra_forbidden":
        return f"{key} = {shown(value)}: unknown key; {_suggestion(key, owner, table)}"
    rule = detail["msg"] if field is None else allowed(field)
    return f"{key}: missing; {rule}" if kind == "missing" else f"{key} = {shown(value)}: {rule}"


def locate(table: type[Table], location: tuple[int | str, ...]) -> tuple[str, type[Table], FieldInfo | None]:
    """Dotted key of a place in a table, the table class that owns it, and its field (None where there is none)."""
    key, owner, field = "", table, None
    inside: type[Table] | None = table  # the table of which the next item is a key
    items = list(location)
    while items:
        item = items.pop(0)
        if inside is None:
            if isinstance(item, int) or (field is not None and get_origin(field.annotation) is dict):
                key = _joined(key, _step(item))
            if isinstance(item, str):
                break  # what follows is pydantic's name of a kind of value that the key may have
            continue
        key, owner, field = _joined(key, _step(item)), inside, inside.model_fields.get(str(item))
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
            key, owner, field = _joined(key, _step(items.pop(0))), inside, FieldInfo.from_annotation(inside)
    return key, owner, field


def _step(item: int | str) -> str:
    """One part of a dotted key."""
    return f"[{item}]" if isinstance(item, int) else quoted(item)


def _joined(key: str, rest: str) -> str:
    return key + rest if not key or not rest or rest.startswith("[") else f"{key}.{rest}"


def quoted(key: str) -> str:
    """A key as TOML writes it: bare, or in quotes."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else shown(key)


def shown(value: object) -> str:
    """A value as a scene writes it, on one line, cut where it is long."""
    try:
        text = _toml_text(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list without end
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
        return "{" + ", ".join(f"{name} = {_toml_text(entry)}" for name, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_text(entry) for entry in value) + "]"
    return str(value)


def _nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> list[str]:
    """The one name that is most like another, in a list, or none."""
    return difflib.get_close_matches(name, known, n=1, cutoff=cutoff)


def _nearest_key(key: str, owner: type[Table]) -> str:
    """The key of the same table that is most like an unknown one, or nothing."""
    parent, _, name = key.rpartition(".")
    return "".join(_joined(parent, near) for near in _nearest(name, owner.model_fields))


def _suggestion(key: str, owner: type[Table], table: type[Table]) -> str:
    """The nearest key of the same table, else a key of the same name in another one, else all keys of the table."""
    parent, _, name = key.rpartition(".")
    if near := _nearest_key(key, owner):
        return f"did you mean {near}?"
    others = [(other, inner) for other, _, inner in sections(table) if other != parent]
    elsewhere = {known: _joined(other, known) for other, inner in others for known in inner.model_fields}
    if names := _nearest(name, elsewhere, cutoff=0.8):
        return f"did you mean {elsewhere[names[0]]}?"
    return "allowed are " + ", ".join(_joined(parent, known) for known in owner.model_fields)


# ---------------------------------------------------------------- what a field allows


def is_table(annotation: object) -> TypeGuard[type[Table]]:
    """Whether an annotation is a table class."""
    return isinstance(annotation, type) and issubclass(annotation, Table)


def variant_of_field(field: FieldInfo) -> VariantOf | None:
    """The registry behind a field that has several kinds of tables, or None."""
    return next((entry for entry in field.metadata if isinstance(entry, VariantOf)), None)


def choices(field: FieldInfo) -> list[object]:
    """The values of a field that has a closed list of them, else an empty list."""
    if variant := variant_of_field(field):
        return list(variant.registry)
    for entry in field.metadata:
        if isinstance(entry, OneOf):
            return entry.choices
    return list(get_args(_kind(field))) if get_origin(_kind(field)) is Literal else []


def _kind(field: FieldInfo) -> object:
    """The annotation of a field that may be left out as that of one that may not."""
    kinds = [kind for kind in get_args(field.annotation) if kind is not NoneType]
    return kinds[0] if get_args(field.annotation) == (*kinds, NoneType) and len(kinds) == 1 else field.annotation


def allowed(field: FieldInfo) -> str:
    """What a field allows, as an error and the reference say it."""
    if listed := choices(field):
        return f"allowed {'is' if len(listed) == 1 else 'are'} " + ", ".join(shown(choice) for choice in listed)
    if isinstance(field.json_schema_extra, dict):
        return f"must be {field.json_schema_extra['allowed']}"
    if is_table(field.annotation) or get_origin(field.annotation) is dict:
        fields: dict[str, FieldInfo] = getattr(field.annotation, "model_fields", {})
        required = [name for name, inner in fields.items() if inner.is_required()]
        return "must be a table" + (f" with {', '.join(required)}" if required else "")
    nouns: dict[object, str] = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a string"}
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    bounds = [
        f"{word} {getattr(entry, name)}"
        for entry in field.metadata
        for name, word in words.items()
        if hasattr(entry, name)
    ]
    return " ".join(filter(None, [f"must be {nouns[_kind(field)]}", " and ".join(bounds)]))


def tables_in(field: FieldInfo) -> Iterator[tuple[str, str, type[Table]]]:
    """Of a field: what stands after its key for a table in it, the variant, the class; NAME stands for a free name."""
    if several := variant_of_field(field):
        yield from (("", tag, kind) for tag, kind in several.registry.items())
        return
    suffix = {dict: ".NAME", tuple: "[]"}.get(get_origin(field.annotation) or str, "")
    yield from ((suffix, "", kind) for kind in (field.annotation, *get_args(field.annotation)) if is_table(kind))


def sections(table: type[Table], key: str = "", variant: str = "") -> Iterator[tuple[str, str, type[Table]]]:
    """(dotted key, variant, class) of a table and of all tables in it; NAME stands for a free name."""
    yield key, variant, table
    if (kind := table.further) is not None:
        yield from sections(kind, _joined(key, "NAME"))
    for name, field in table.model_fields.items():
        for suffix, tag, inner in tables_in(field):
            yield from sections(inner, _joined(key, name) + suffix, tag)


# ---------------------------------------------------------------- documentation


def description(table: type[Table], name: str) -> str:
    """What a field means, on one line."""
    return " ".join((table.model_fields[name].description or "").split())


def meaning(table: type[Table]) -> str:
    """What a reader of scenes is told of a table: its docstring up to what scripts need."""
    return re.split(r"\n\nIts keyword arguments |\n\n\w+\n---", inspect.cleandoc(table.__doc__ or ""))[0]
