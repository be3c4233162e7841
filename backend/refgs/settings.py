"""Declare all settings: keys, ranges and descriptions. Values are in presets/*.toml; docs/settings.md lists all settings."""

import os
import reprlib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, cast

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from refgs.errors import InputError
from refgs.paths import PRESETS, read_text

Length = Annotated[FiniteFloat, Field(ge=0)]
Part = Annotated[float, Field(ge=0, le=1)]
Need = Literal["auto", "on", "off"]
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RegionSettings(_Section):
    """Box around the wanted part of a capture, and the direction that is up in the result.

    Both are in the coordinates of the cameras.json that a training without a region writes (docs/run-folder.md).
    """

    centre: Vector = Field(description="centre of the box")
    size: tuple[Length, Length, Length] = Field(description="edge lengths of the box; three zeros: no box")
    rotation: Vector = Field(
        description="rotation of the box: degrees about fixed x, then y, then z (Blender's XYZ Euler angles)"
    )
    up: Vector = Field(description="direction of the result's +Z, of any length; three zeros: found from the cameras")

    @model_validator(mode="after")
    def _has_a_volume(self) -> "RegionSettings":
        if any(self.size) and not all(self.size):
            size = list(self.size)
            raise ValueError(
                f"size = {size}: each of the three must be greater than 0, or all must be 0, for no region"
            )
        return self


class ImageSettings(_Section):
    """Preparation of the photos for the training."""

    max_side: int = Field(ge=16, le=8192, description="pixels on the longer side; larger photos are reduced to it")
    coarse: Literal["auto", "off"] = Field(
        description="auto: train on reduced photos first, if masks show that the object spans 200 pixels or more in them; off: on full "
        "photos from the start"
    )
    background: tuple[Part, Part, Part] = Field(description="sRGB colour behind masked objects")
    masks: Literal["auto", "off"] = Field(
        description="auto: if no photo has a mask, make masks of the object first, in the capture's folder masks; off: make none, and "
        "learn all that photos without masks show"
    )


# Said as type checkers read it: `method_of` caches by these settings, so they must be known to be hashable.
class RenderSettings(BaseModel, extra="forbid", frozen=True):
    """Shading: how material and light give a pixel's colour."""

    shading: Literal["deferred", "splat", "sh"] = Field(description="deferred: materials are blended, then shaded")
    diffuse: Literal["irradiance", "sh"] = Field(description="diffuse light: the environment's, or SH per surfel")
    reflection: Literal["microfacet", "mirror", "none"] = Field(description="GGX microfacets, or no reflection")
    color_space: Literal["linear", "display"] = Field(description="linear: HDR radiance is learned")

    @model_validator(mode="after")
    def _mirrors_have_colours_of_their_own(self) -> "RenderSettings":
        if self.reflection == "mirror" and self.diffuse != "sh":
            raise ValueError("reflection = mirror takes diffuse = sh; add --set diffuse=sh")
        if self.reflection == "none" and self.diffuse != "irradiance":
            raise ValueError("reflection = none takes diffuse = irradiance; add --set diffuse=irradiance")
        return self


class SurfelSettings(_Section):
    """Kind and number of surfels, and their values at the start of the training."""

    primitive: Literal["2dgs", "3dgs"] = Field(description="2dgs: flat discs")
    start: int = Field(ge=1, le=10_000_000, description="number of surfels at the start")
    budget: int = Field(ge=1, le=10_000_000, description="maximum number of surfels")
    density: float = Field(
        ge=0,
        description="maximum number of surfels for each pixel of the object in a photo, where that is less than budget and more "
        "than twice start; smaller objects have 1 a pixel; 0: budget, start and the light's resolution are as set",
    )
    hull: int = Field(ge=16, le=512, description="voxels along each side of the visual hull")
    inside: float = Field(
        ge=0, lt=1, description="part of the first surfels inside the visual hull; the others lie on it"
    )
    sh_degree: int = Field(ge=0, le=3, description="highest degree of spherical harmonics per surfel")
    opacity: float = Field(gt=0, lt=1, description="opacity at the start")
    albedo: float = Field(gt=0, lt=1, description="albedo at the start")
    metallic: float = Field(gt=0, lt=1, description="metallic at the start")
    roughness: float = Field(gt=0, lt=1, description="roughness at the start")


class EnvironmentSettings(_Section):
    """Learned light, a cubemap."""

    resolution: Literal[16, 32, 64, 128, 256] = Field(description="texels along each side of the cubemap's faces")
    radiance: float = Field(gt=0, le=1e6, description="radiance at the start, at most: less if the photos are darker")
    diffusion: float = Field(
        ge=0,
        description="smoothing per iteration, a part of rates.environment: how much of a texel flows into its neighbours, at 64 texels "
        "a side; scaled at other resolutions. Suppresses noise where photos hardly show the light",
    )
    grey: float = Field(
        ge=0,
        description="fading per iteration, a part of rates.environment: how much of a texel's colour turns to grey. Light that photos "
        "hardly show then has no colour",
    )


class LightSettings(_Section):
    """Light and exposure that vary between photos."""

    frame: Literal["auto", "world", "camera"] = Field(
        description="light fixed to the world, or to the camera as on a turntable; auto: found from the photos"
    )
    exposure: Need = Field(description="exposure and white balance per photo; auto: each is off if the photos agree")


class CameraSettings(_Section):
    """Refinement of the cameras' poses."""

    poses: Need = Field(
        description="refine the photos' poses; auto: only if features that photos share tell that they are not exact"
    )


class TrainSettings(_Section):
    """Length and seed of a training."""

    iterations: int = Field(ge=1, le=10_000_000, description="number of iterations, one photo each")
    light_first: int = Field(ge=0, description="iterations at the start in which geometry is frozen")
    checkpoint_every: int = Field(ge=1, description="iterations between checkpoints")
    seed: int = Field(ge=0, description="seed of all random choices")


class InitialSettings(_Section):
    """Initial stage: surfels are shaded before they are blended. Then only geometry is kept; colour, material and light start anew."""

    until: float = Field(ge=0, lt=1, description="end of the stage, a part of the training; 0: no such stage")


class IndirectSettings(_Section):
    """Inter-reflection: the object's reflection in itself. Mirror rays are traced against a mesh."""

    start: float = Field(ge=0, le=1, description="start, a part of the training; 1: never")
    every: int = Field(ge=1, description="iterations between meshes")
    resolution: int = Field(ge=16, le=1024, description="voxels along each side of the mesh's volume")
    least: float = Field(
        ge=0, le=1, description="smallest part of the object that reflects the object; below it, left out"
    )


class ResidualSettings(_Section):
    """Residual: a view-dependent sRGB-encoded colour that adds what material and light do not explain. Left out under another light."""

    start: float = Field(
        gt=0, le=1, description="start, a part of the training; material and light are frozen from then on. 1: never"
    )


class RateSettings(_Section):
    """Adam's learning rates at the start, and the factors that they decay by."""

    position: float = Field(ge=0, description="position, in scene radii")
    rotation: float = Field(ge=0, description="rotation quaternion")
    scale: float = Field(ge=0, description="logarithm of the scale")
    opacity: float = Field(ge=0, description="logit of the opacity")
    sh_dc: float = Field(ge=0, description="colour, SH degree 0")
    sh_rest: float = Field(ge=0, description="colour, SH degrees above 0")
    residual: float = Field(ge=0, description="residual colour (section residual)")
    albedo: float = Field(ge=0, description="logit of the albedo")
    metallic: float = Field(ge=0, description="metallic, as the logit of its inverse smoothstep")
    roughness: float = Field(ge=0, description="logit of the roughness")
    indirect_dc: float = Field(ge=0, description="indirect light, SH degree 0")
    indirect_rest: float = Field(ge=0, description="indirect light, SH degrees above 0")
    environment: float = Field(ge=0, description="texels of the light")
    exposure: float = Field(ge=0, description="logarithm of a photo's exposure and white balance")
    decay: float = Field(gt=0, le=1, description="factor on every rate but position's at the end of the training")
    position_decay: float = Field(gt=0, le=1, description="factor on position's rate at position_until")
    position_until: float = Field(
        gt=0, le=1, description="part of the training after which position's rate is constant"
    )


RATES = tuple(name for name in RateSettings.model_fields if not name.startswith(("decay", "position_")))
"""Names of the learning rates, without the decays."""


class LossSettings(_Section):
    """Weights of the terms of the loss."""

    dssim: float = Field(ge=0, le=1, description="λ in (1 − λ) L1 + λ D-SSIM")
    normal: float = Field(ge=0, description="consistency of normals with depth")
    smooth: float = Field(ge=0, description="edge-aware smoothness of normals")
    even: float = Field(ge=0, description="edge-aware smoothness of metallic and roughness")
    alpha: float = Field(ge=0, description="agreement with the mask")
    metallic: float = Field(ge=0, description="penalty of metallic between 0 and 1, growing with progress²")
    matte: float = Field(ge=0, description="penalty of roughness above 0.3")
    light: float = Field(ge=0, description="penalty of a coloured mean of the light")
    prior: float = Field(
        ge=0,
        description="agreement with the capture's normals and depth from other programs, if it has any (docs/photos.md); fades to 0",
    )
    outlines: float = Field(
        ge=0, description="agreement of normals with outlines of the masks, where these show the surface"
    )
    mesh: float = Field(
        ge=0, description="agreement of rough paint's normals with the mesh that reflections are traced on"
    )
    exposure: float = Field(ge=0, description="penalty of a photo's exposure or white balance that differs from most")


class NeedsSettings(_Section):
    """Parts of the method that some scenes do not need. `on` keeps a part, `off` drops it, `auto` measures whether the scene needs it."""

    views: Need = Field(description="photos from the same place as another one")
    outside: Need = Field(description="pixels outside the mask, apart from a margin")
    initial: Need = Field(description="initial stage (section initial)")
    specular: Need = Field(description="specular reflection; without it the scene is matte")
    iterations: Need = Field(description="a fifth of the iterations, if the scene is matte")
    reflections: Need = Field(description="inter-reflection (section indirect)")
    light: Need = Field(description="texels of the light finer than the sharpest reflection of it")
    degrees: Need = Field(description="higher SH degrees of the residual")
    constants: Need = Field(
        description="columns metallic and roughness of splats.ply, if all surfels have the same value"
    )


class DensifySettings(_Section):
    """Adding and removing surfels during the training."""

    start: float = Field(ge=0, le=1, description="start, a part of the training")
    stop: float = Field(ge=0, le=1, description="part of the training after which surfels are only removed")
    every: int = Field(ge=1, description="iterations between passes")
    gradient: float = Field(
        ge=0, description="threshold on a surfel's mean screen-space gradient, above which it is split"
    )
    prune_opacity: float = Field(ge=0, lt=1, description="opacity below which surfels are removed")
    reset_every: int = Field(ge=0, description="iterations between opacity resets, until stop; 0: none")


class PropagationSettings(_Section):
    """Material-aware normal propagation (Ref-Gaussian, §3.3). At intervals, shiny metal surfels grow and so pass on their normals."""

    every: int = Field(ge=0, description="iterations between passes; 0: none")
    stop: float = Field(ge=0, le=1, description="end, a part of the training")
    metallic: float = Field(ge=0, le=1, description="least metallic of the surfels that grow")
    roughness: float = Field(ge=0, le=1, description="greatest roughness of the surfels that grow")
    growth: float = Field(ge=1, description="factor on their size")
    opacity: float = Field(gt=0, lt=1, description="least opacity of all surfels after a pass")
    rest: int = Field(ge=0, description="iterations after a pass in which opacity is frozen")


class MeshSettings(_Section):
    """Size of the exported mesh and its textures."""

    resolution: int = Field(ge=16, le=1024, description="voxels along each side of the fused volume")
    triangles: int = Field(ge=100, le=10_000_000, description="number of triangles after simplification")
    texture: int = Field(ge=64, le=8192, description="pixels along each side of the textures")


class Settings(_Section):
    """All settings of a run. Every value is in the preset; the code has no defaults."""

    region: RegionSettings
    image: ImageSettings
    render: RenderSettings
    surfels: SurfelSettings
    environment: EnvironmentSettings
    light: LightSettings
    cameras: CameraSettings
    train: TrainSettings
    initial: InitialSettings
    indirect: IndirectSettings
    residual: ResidualSettings
    rates: RateSettings
    loss: LossSettings
    densify: DensifySettings
    propagation: PropagationSettings
    needs: NeedsSettings
    mesh: MeshSettings


REMOVED = (("loss", "dark"),)  # sections and keys that only runs of earlier releases have
SHORT = {"primitive": "surfels.primitive"} | {key: f"render.{key}" for key in RenderSettings.model_fields}
"""Keys that `--set` takes without their section."""

COMPARISON = {
    "render.shading": {
        "splat": "each surfel is shaded before it is blended",
        "sh": "no materials, only colour by direction (spherical harmonics, SH): no relighting",
    },
    "render.reflection": {"mirror": "mirrors in front of `diffuse = sh`, with metallic as their share"},
    "render.color_space": {"display": "sRGB-encoded values 0..1 are learned"},
    "surfels.primitive": {"3dgs": "3D Gaussians"},
}
"""Values that exist only for comparison with papers, and what they do."""


def preset_names() -> list[str]:
    """Return the names of the program's presets."""
    return sorted(file.stem for file in PRESETS.glob("*.toml"))


class Assignment(NamedTuple):
    """Hold one change of a setting, parsed from its `text`, which is `section.key=value`."""

    text: str
    section: str
    name: str
    value: Any


def load_settings(preset: str, changes: Iterable[str] = ()) -> Settings:
    """Load a preset, and apply changes of the form `section.key=value`. `preset` is the name of a preset, or a TOML file.

    A file may start from a preset with `base = "NAME"`. Raises InputError naming the wrong key, and the keys or values that are allowed.
    """
    return preset_settings(preset, map(parse_change, changes))


def preset_settings(preset: str, changes: Iterable[Assignment]) -> Settings:
    """Load a preset as `load_settings` does, and apply changes that `parse_change` returned."""
    tables = _read_preset(preset)
    for change in changes:
        if not isinstance(tables.setdefault(change.section, {}), dict):
            raise InputError(f"--set {change.text}: there is no section {change.section}")
        tables[change.section][change.name] = change.value
    return validate(tables, preset)


def parse_change(text: str) -> Assignment:
    """Parse a change `section.key=value`. Some keys need no section (`SHORT`). Raises InputError if the text has another form."""
    key, equals, value = text.partition("=")
    key = SHORT.get(key.strip(), key.strip())
    section, dot, name = key.partition(".")
    if not equals or not dot:
        raise InputError(f"--set {text}: write it as section.key=value, e.g. train.iterations=2000")
    return Assignment(text, section, name, _parse(value))


def recorded_settings(tables: dict[str, Any], source: str) -> Settings:
    """Make `Settings` from the tables of settings that a run recorded. `source` names their file in error messages.

    A run of an older release may lack a key. The key then gets the value that matches how that release worked, or the value of the preset
    `standard`. Keys in REMOVED are dropped.
    """
    # Before these keys existed, light was fixed to the world, there were no exposures and no residual, and nothing was left out.
    still = {"light": {"frame": "world", "exposure": "off"}, "residual": {"start": 1.0}}
    still |= {"cameras": {"poses": "off"}, "image": {"coarse": "off"}, "loss": {"prior": 0.0}}
    still["needs"] = dict.fromkeys(NeedsSettings.model_fields, "on")
    known = _merge(_merge(_read_preset("standard"), still), tables)
    for section, key in REMOVED:
        if isinstance(known[section], dict):
            known[section].pop(key, None)
    return validate(known, source)


def validate(tables: dict[str, Any], source: str) -> Settings:
    """Make `Settings` from tables, {section: {key: value}}. `source` names the tables' file in error messages.

    Raises InputError naming the first wrong key, and the keys or values that are allowed.
    """
    try:
        return Settings.model_validate(tables)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _known_keys(first["loc"][:-1])
            raise InputError(f"{source}: unknown key {key[:100]}; known here: {', '.join(known)}") from None
        if first["type"] == "missing":
            raise InputError(f'{source}: {key} is missing; add it, or start the file with base = "standard"') from None
        if first["type"] == "value_error":
            raise InputError(f"{source}: {key}: {first.get('ctx', {})['error']}") from None
        raise InputError(f"{source}: {key} = {reprlib.repr(first['input'])}: {first['msg'].lower()}") from None


def _known_keys(location: tuple) -> list[str]:
    model: type[BaseModel] = Settings
    for part in location:
        model = cast(type[BaseModel], model.model_fields[part].annotation)  # only sections have keys below them
    return list(model.model_fields)


def _parse(value: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except (ValueError, KeyError):  # no TOML, a number of thousands of digits, or more than a value
        return value.strip()  # a bare word is a string
    except RecursionError:
        raise InputError(f"--set {value[:60]}…: this is nested too deeply") from None


def _read_preset(preset: str) -> dict[str, Any]:
    file = PRESETS / f"{preset}.toml" if preset in preset_names() else Path(preset)
    if not os.path.lexists(file):
        raise InputError(f"no preset {preset}: take one of {', '.join(preset_names())}, or a TOML file")
    try:
        tables = tomllib.loads(read_text(file, "Mend the file."))
    except RecursionError:
        raise InputError(f"{file}: cannot be read as TOML (it is nested too deeply): mend the file") from None
    except ValueError as error:
        raise InputError(f"{file}: cannot be read as TOML ({error}): mend the file") from None
    base = tables.pop("base", None)
    if base is None:
        return tables
    if base not in preset_names() or base == preset:
        raise InputError(f"{file}: base = {base!r}: take one of {', '.join(preset_names())}")
    return _merge(_read_preset(base), tables)


def _merge(base: dict[str, Any], tables: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for section, values in tables.items():
        both = isinstance(values, dict) and isinstance(base.get(section, {}), dict)
        merged[section] = {**base.get(section, {}), **values} if both else values
    return merged
