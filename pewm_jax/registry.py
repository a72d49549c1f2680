"""The registry of kinds: the classes that a section of a model may hold, by name.

A model consists of parts: a backbone, a codec, a control, a memory with its encoder and reader, a
noise; a world assembles them. Each part comes in several kinds. A kind is one class: a frozen
dataclass whose fields are its settings and whose methods are its functions. Its base class in
``pewm_jax.config.parts`` documents the methods. A decorator registers it::

    @register("codec", "turn")
    @dataclasses.dataclass(frozen=True)
    class TurnCodec(Codec):
        spatial: int = 4

        def encode(self, params, video_BTHWC, *, condition=False): ...

In JSON, a section names its kind: ``{"codec": {"kind": "turn", "spatial": 8}}``. Built-in kinds are
listed in ``BUILT_IN`` and imported when they are first used. If a name is unknown, the modules of
the entry-point group ``pewm_jax.kinds`` are imported, by which installed packages register kinds.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
import warnings
from collections.abc import Callable
from importlib import metadata
from typing import Any, ClassVar

from pewm_jax.errors import ConfigError


class Settings:
    """Base class of the settings of all kinds.

    Attributes:
        SECTION: the section of a model that they belong to.
    """

    SECTION: ClassVar[str] = ""

    def check(self, model: Any) -> None:
        """Refuse a model that these settings do not fit with a ``ConfigError``."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of one part.

    Attributes:
        section: the part, such as ``backbone``.
        name: its name in JSON and flags.
        settings: its class, a frozen dataclass derived from the section's interface.
    """

    section: str
    name: str
    settings: type


GROUP = "pewm_jax.kinds"
"""The entry points whose modules register kinds when they are imported."""

BUILT_IN: dict[str, dict[str, str]] = {
    "world": {
        "pewm": "pewm_jax.worlds.pewm.world:PEWM",
        "codec": "pewm_jax.worlds.codec:CodecTask",
        "egowm": "pewm_jax.worlds.egowm.world:EgoWM",
        "persist": "pewm_jax.worlds.persist.world:PERSIST",
        "nomad": "pewm_jax.worlds.nomad:NomadTask",
    },
    "backbone": {
        "dit": "pewm_jax.models.cogvideox.backbone:DiTBackbone",
        "uvit": "pewm_jax.models.uvit:UViTBackbone",
        "svd_unet": "pewm_jax.models.svd.unet:SVDUNetBackbone",
        "cosmos": "pewm_jax.models.cosmos.backbone:CosmosBackbone",
        "persist": "pewm_jax.models.persist.nets:PersistNetsConfig",
    },
    "codec": {
        "pixel": "pewm_jax.codecs.pixel:PixelConfig",
        "vae": "pewm_jax.models.cogvideox.vae:VAECodec",
        "svd_vae": "pewm_jax.models.svd.vae:SVDVAECodec",
        "wan_vae": "pewm_jax.models.wan.vae:WanVAECodec",
        "learned": "pewm_jax.codecs.learned:LearnedCodecConfig",
    },
    "control": {
        "camera": "pewm_jax.controls.camera:CameraConfig",
        "actions": "pewm_jax.controls.actions:ModulationConfig",
    },
    "encoder": {
        "patch_colours": "pewm_jax.encoders.simple:PatchColoursConfig",
        "latents": "pewm_jax.encoders.simple:LatentsConfig",
        "dinov2": "pewm_jax.models.dinov2.model:DINOv2EncoderConfig",
    },
    "reader": {
        "attend": "pewm_jax.readers.attention:AttentionConfig",
        "render": "pewm_jax.readers.render:RenderConfig",
        "both": "pewm_jax.readers.render:BothConfig",
    },
    "memory": {
        "voxel": "pewm_jax.memory.voxel_map:VoxelConfig",
        "map2d": "pewm_jax.memory.voxel_map:Map2DConfig",
        "points": "pewm_jax.memory.points:PointsConfig",
        "surfels": "pewm_jax.memory.surfels:SurfelConfig",
        "grid": "pewm_jax.memory.class_grid:GridConfig",
        "images": "pewm_jax.memory.images:ImagesConfig",
        "none": "pewm_jax.memory.none:NoMemoryConfig",
    },
    "noise": {
        "ddpm": "pewm_jax.diffusion.ddpm:DDPMConfig",
        "edm": "pewm_jax.diffusion.edm:EDMConfig",
        "flow": "pewm_jax.diffusion.flow:FlowConfig",
        "frame_flow": "pewm_jax.diffusion.flow:FrameFlowConfig",
    },
    "draft": {
        "none": "pewm_jax.config.parts:Draft",
        "network": "pewm_jax.worlds.draft:NetworkDraft",
    },
    "format": {
        "7scenes": "pewm_jax.data.formats.seven_scenes:SevenScenes",
        "arkitscenes": "pewm_jax.data.formats.arkitscenes:ARKitScenes",
        "habitat": "pewm_jax.data.formats.habitat:Habitat",
        "lerobot": "pewm_jax.data.formats.lerobot:LeRobot",
        "nomad": "pewm_jax.data.formats.nomad:NoMaD",
        "open3d": "pewm_jax.data.formats.recording:Open3D",
        "replica": "pewm_jax.data.formats.replica:Replica",
        "scannet": "pewm_jax.data.formats.scannet:ScanNet",
        "scenezoo": "pewm_jax.data.formats.scene_zoo:SceneZoo",
        "stray": "pewm_jax.data.formats.stray:Stray",
        "tum": "pewm_jax.data.formats.recording:TUM",
    },
}
"""Section → name → "module:class" of the kinds of this package, imported when first used."""

_KINDS: dict[tuple[str, str], Kind] = {}
_ENTERED: set[str] = set()
"""Modules of entry points that were imported, or are being imported."""


def register(section: str, name: str, settings: type | None = None, where: Any = None) -> Any:
    """Register a kind, by a call or as a decorator: ``@register("codec", "turn")``.

    Registering the same class again replaces it: the same object, or the class that a notebook's
    cell or a reloaded module defines again. A file that runs as two modules registers the class of
    the first.

    Args:
        section: the part of a model, such as ``backbone``.
        name: the kind's name in JSON and flags.
        settings: a frozen dataclass, subclass of the section's interface; None returns a decorator.
        where: deprecated: a module with the functions of the kind, its name or another object.

    Raises:
        ConfigError: the class is not a frozen dataclass or is of another section, lacks methods, or
            the name is taken by another class.
    """
    if settings is None:
        return lambda decorated: register(section, name, decorated)
    if not (isinstance(settings, type) and issubclass(settings, Settings)) or (
        section != settings.SECTION
    ):
        raise ConfigError(
            f"{getattr(settings, '__name__', settings)} cannot be registered as a {section}: "
            f"derive a class from the interface of that section, with SECTION = {section!r}."
        )
    parameters = vars(settings).get("__dataclass_params__")
    if parameters is None or not parameters.frozen:
        raise ConfigError(
            f"{settings.__name__} cannot be registered as a {section}: it is no frozen dataclass, "
            "so write @dataclasses.dataclass(frozen=True) above it."
        )
    missing = where is None and _missing(settings)
    if missing:
        raise ConfigError(
            f"{settings.__name__} cannot be registered as a {section}: it lacks the methods "
            f"{', '.join(missing)}; see {settings.__mro__[1].__name__}."
        )
    built_in = BUILT_IN.get(section, {}).get(name)
    taken = _KINDS.get((section, name))
    if taken is not None and not _same(taken.settings, settings):
        found = taken.settings.__name__
    elif built_in is not None and built_in != _address(settings):
        found = built_in.partition(":")[2]
    elif taken is not None and taken.settings.__module__ != settings.__module__:
        return taken.settings  # one file run as two modules: both hold the first class
    else:
        if where is not None:
            _add_methods(section, name, settings, where)
        _KINDS[section, name] = Kind(section, name, settings)
        return settings
    raise ConfigError(f"There is a {section} {name!r} already ({found}); choose another name.")


def _missing(settings: type) -> list[str]:
    """Return the names of abstract methods that a class does not override."""
    every = ((name, getattr(settings, name, None)) for name in dir(settings))
    return [name for name, value in every if getattr(value, "__isabstractmethod__", False)]


_FUNCTIONS: dict[str, tuple[str, ...]] = {
    "noise": ("shown", "target", "draw", "corrupt", "weight", "to_x0", "levels", "sample"),
    "codec": ("init", "encode", "decode", "measured"),
    "encoder": ("init", "encode", "preprocessing"),
    "backbone": ("init", "apply", "init_image", "observed"),
    "control": ("init", "condition"),
    "world": (
        *("init", "stages", "sharding", "split_heads", "start", "observe", "imagine"),
        *("imagine_many", "to_compare", "views", "memory_points", "point_colours"),
        *("erase", "move", "coverage"),
    ),
}
"""Section → functions of a module in version 0.1 that are methods now."""
_RENAMED = {"shown": "precondition", "target": "prediction_target"}
"""Function → its method, if the name is another."""
_OF_THE_MODEL = {("backbone", "observed"), ("control", "init"), ("control", "condition")}
"""Functions whose first argument was the model and not the settings."""


def _add_methods(section: str, name: str, settings: type, where: Any) -> None:
    """Turn the functions of a module, as in version 0.1, into methods of the settings."""
    warnings.warn(
        f"register({section!r}, …) with a module of functions is deprecated: make them methods "
        f"of {settings.__name__}, as pewm_jax.config documents them.",
        DeprecationWarning,
        stacklevel=3,
    )

    def find(function: str) -> Any:
        module = imported(where, f"{section} of kind {name!r}") if isinstance(where, str) else where
        return getattr(module, function, None)

    for function in _FUNCTIONS.get(section, ()):
        method = _RENAMED.get(function, function)
        of_model = (section, function) in _OF_THE_MODEL
        inherited = getattr(settings, method)
        setattr(settings, method, _method(find, function, inherited, of_model=of_model))
    if hasattr(settings, "SHARDING"):
        settings.SHARDING = property(lambda _: find("SHARDING") or ())  # type: ignore[attr-defined]


def _method(find: Any, function: str, inherited: Any, *, of_model: bool) -> Any:
    """Return a method that calls a module's function, or the inherited method without one."""

    def call(self: Any, *args: Any, **named: Any) -> Any:
        own = find(function)
        if own is None:
            return inherited(self, *args, **named)
        return own(*args, **named) if of_model else own(self, *args, **named)

    return call


def part(section: str, name: str, **settings: Any) -> Any:
    """Return a dataclass field whose default is created when a value is needed.

    ``codec: Codec = part("codec", "pixel")`` imports the pixel codec only when a model without
    another codec is built. ``settings`` are those of the default that differ from the kind's own;
    parts among them are also created by ``part``.
    """

    def make() -> Any:
        values = {
            key: default_of(value) if isinstance(value, dataclasses.Field) else value
            for key, value in settings.items()
        }
        return named(section, name).settings(**values)

    return dataclasses.field(default_factory=make, metadata={"section": section, "kind": name})


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a field; ``dataclasses.MISSING`` if it has none."""
    if field.default_factory is dataclasses.MISSING:
        return field.default
    return field.default_factory()


def usual(field: dataclasses.Field[Any]) -> type:
    """Return the type of a field's default; for a field made by ``part``, its kind's class."""
    if "section" in field.metadata:
        return named(field.metadata["section"], field.metadata["kind"]).settings
    return type(default_of(field))


def _address(settings: type) -> str:
    return f"{settings.__module__}:{settings.__qualname__}"


def _same(one: type, other: type) -> bool:
    """Tell whether two classes are one, or one definition in a file that runs as two modules."""
    if one.__qualname__ != other.__qualname__:
        return False
    files = [_file(kind) for kind in (one, other)]
    return one.__module__ == other.__module__ or (None not in files and files[0] == files[1])


def _file(kind: type) -> str | None:
    """Return the path of the file that defines a class, None if there is none."""
    path = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return None if path is None else os.path.realpath(path)


def names(section: str) -> list[str]:
    """Return the names of the kinds of a section."""
    return sorted({name for known, name in _KINDS if known == section} | set(BUILT_IN[section]))


def named(section: str, name: str) -> Kind:
    """Return a kind by its name; if it is unknown, import the modules of entry points first.

    Raises:
        ConfigError: there is no such kind; the message lists the known ones, and the modules of
            entry points that could not be imported.
    """
    failed: list[str] = []
    if isinstance(name, str):  # a table read from JSON may hold anything
        if (section, name) not in _KINDS and name in BUILT_IN.get(section, {}):
            module, _, attribute = BUILT_IN[section][name].partition(":")
            settings = getattr(imported(module, f"{section} of kind {name!r}"), attribute)
            register(section, name, settings)
        if (section, name) not in _KINDS:
            failed = _import_entry_points()
        if (section, name) in _KINDS:
            return _KINDS[section, name]
    raise ConfigError(
        f"There is no {section} of kind {name!r}; the kinds are {', '.join(names(section))} (to "
        "use a kind of your own, give the command --plugin FILE, or name its module in an entry "
        f"point of the group {GROUP!r})"
        + "".join(f"; {sentence.removesuffix('.')}" for sentence in failed)
        + "."
    )


def _import_entry_points() -> list[str]:
    """Import each module that installed packages name, once; return the errors."""
    failed = []
    for point in metadata.entry_points(group=GROUP):
        if point.module in _ENTERED:
            continue
        _ENTERED.add(point.module)  # before: what it imports may ask for a kind
        try:
            imported(point.module, f"entry point {point.name!r} of {GROUP}")
        except ConfigError as error:
            _ENTERED.discard(point.module)
            failed.append(str(error))
    return failed


def imported(name: str, what: str) -> Any:
    """Import a user's module; ``what`` needs it and is named in the error.

    Raises:
        ConfigError: it cannot be imported, for whatever reason.
    """
    try:
        return importlib.import_module(name)
    except Exception as error:  # a module may raise anything when it is run
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(
            f"{what}: the module {name} cannot be imported ({reason}); mend it, install what it "
            "needs, or put it where Python looks for modules."
        ) from error


def of(settings: Any) -> Kind:
    """Return the kind of settings, by their type.

    Raises:
        ConfigError: their type is not registered.
    """
    kind = type(settings)
    same: tuple[Callable[[type, type], bool], ...] = (lambda one, other: one is other, _same)
    for equal in same:
        for known in _KINDS.values():
            if equal(known.settings, kind):
                return known
    for section, table in BUILT_IN.items():
        for name, address in table.items():
            if address == _address(kind):
                return named(section, name)
    raise ConfigError(
        f"{kind.__name__} is not registered: call pewm_jax.config.register(section, name, "
        f"{kind.__name__}) once, where it is defined."
    )


def require_section(value: Any, section: str, where: str) -> None:
    """Refuse a value that is not settings of a section, also in the sections below it.

    ``where`` is its name in the error.
    """
    given = not isinstance(value, type) and dataclasses.is_dataclass(value)
    if not given or getattr(value, "SECTION", None) != section:
        found = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        there = [address.partition(":")[2] for address in BUILT_IN[section].values()]
        there += [kind.settings.__name__ for kind in _KINDS.values() if kind.section == section]
        raise ConfigError(
            f"{where} is {found}: give it settings of the section {section!r}, such as "
            f"{' or '.join(dict.fromkeys(there))}."
        )
    for field in dataclasses.fields(value):
        below = field.metadata.get("section", getattr(field.default, "SECTION", None))
        if below is not None:
            require_section(getattr(value, field.name), below, f"{where}.{field.name}")
