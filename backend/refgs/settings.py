"""Settings: what a preset may say, within which range. The numbers themselves live in presets/*.toml."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from refgs.errors import InputError
from refgs.paths import PRESETS

Length = Annotated[FiniteFloat, Field(ge=0)]
Part = Annotated[float, Field(ge=0, le=1)]
Need = Literal["auto", "on", "off"]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RegionSettings(_Section):
    """What of a capture is wanted, a box, and which way is up: in the frame of the cameras.json of a run without (docs/run-folder.md)."""

    centre: tuple[FiniteFloat, FiniteFloat, FiniteFloat]
    size: tuple[Length, Length, Length] = Field(description="the lengths of its edges; three zeros take all")
    rotation: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        description="degrees about x, then about y, then about z, which stand still: Blender's XYZ Euler angles"
    )
    up: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        description="the direction that is to be the result's +Z, of any length; three zeros leave it to the cameras"
    )

    @model_validator(mode="after")
    def _has_a_volume(self) -> "RegionSettings":
        if any(self.size) and not all(self.size):
            size = list(self.size)
            raise ValueError(
                f"size = {size}: each of the three must be greater than 0, or all must be 0, for no region"
            )
        return self


class ImageSettings(_Section):
    max_side: int = Field(ge=16, le=8192, description="photos are reduced to this many pixels on their longer side")
    background: tuple[Part, Part, Part] = Field(description="sRGB colour behind masked objects, 0..1")


class RenderSettings(_Section):
    shading: Literal["deferred", "splat", "sh"] = Field(
        description="split-sum materials, of what was blended or of each surfel before; or plain view-dependent colour"
    )
    diffuse: Literal["irradiance", "sh"] = Field(description="diffuse light: from the environment, or SH per surfel")
    reflection: Literal["microfacet", "mirror", "none"] = Field(
        description="of metals and dielectrics, by roughness; none, of what is matte; or, to compare with, a mirror's before diffuse = sh, "
        "metallic its share"
    )
    color_space: Literal["linear", "display"] = Field(
        description="radiance is linear, HDR, and encoded as sRGB at the end; or a screen's numbers, 0..1, as in the paper"
    )

    @model_validator(mode="after")
    def _mirrors_have_colours_of_their_own(self) -> "RenderSettings":
        if self.reflection == "mirror" and self.diffuse != "sh":
            raise ValueError("reflection = mirror takes diffuse = sh; add --set diffuse=sh")
        if self.reflection == "none" and self.diffuse != "irradiance":
            raise ValueError("reflection = none takes diffuse = irradiance; add --set diffuse=irradiance")
        return self


class SurfelSettings(_Section):
    primitive: Literal["2dgs", "3dgs"] = Field(description="flat discs, or 3D Gaussians, to compare with")
    start: int = Field(ge=1, le=10_000_000, description="surfels at the start")
    budget: int = Field(ge=1, le=10_000_000, description="surfels at the most")
    hull: int = Field(ge=16, le=512, description="voxels along each side of the visual hull's grid")
    inside: float = Field(
        ge=0, lt=1, description="part of the surfels that start inside the visual hull, the others on it"
    )
    sh_degree: int = Field(ge=0, le=3)
    opacity: float = Field(gt=0, lt=1, description="at the start")
    albedo: float = Field(gt=0, lt=1, description="at the start")
    metallic: float = Field(gt=0, lt=1, description="at the start")
    roughness: float = Field(gt=0, lt=1, description="at the start")


class EnvironmentSettings(_Section):
    resolution: Literal[16, 32, 64, 128, 256] = Field(description="side of the cubemap's faces, in texels")
    radiance: float = Field(gt=0, le=1e6, description="at the start")
    diffusion: float = Field(
        ge=0,
        description="of texels of 6×64² into their neighbours, a part of the light's rate, and as far on the sphere at other resolutions; "
        "keeps noise out of what photos hardly show",
    )


class LightSettings(_Section):
    frame: Literal["auto", "world", "camera"] = Field(
        description="whether the light stands still or turns with the camera, as on a turntable; auto asks the photos"
    )
    exposure: Literal["auto", "on", "off"] = Field(
        description="whether each photo has an exposure of its own; auto leaves them out where the photos agree"
    )


class TrainSettings(_Section):
    iterations: int = Field(ge=1, le=10_000_000)
    light_first: int = Field(ge=0, description="iterations in which only light and materials learn")
    checkpoint_every: int = Field(ge=1, description="iterations")
    seed: int = Field(ge=0)


class InitialSettings(_Section):
    until: float = Field(
        ge=0,
        lt=1,
        description="part of the training in which each surfel is shaded by itself; then colour, material and light start anew",
    )


class IndirectSettings(_Section):
    start: float = Field(
        ge=0, le=1, description="part of the training after which inter-reflection joins; 1 does without"
    )
    every: int = Field(ge=1, description="iterations between meshes")
    resolution: int = Field(ge=16, le=1024, description="voxels along each side of the mesh's volume")
    least: float = Field(ge=0, le=1, description="part of the object that must mirror the object, else it is left out")


class ResidualSettings(_Section):
    """Colour by direction, sRGB-encoded, that adds to the picture what material and light leave over; gone under another light."""

    start: float = Field(
        gt=0,
        le=1,
        description="part of the training after which it learns, and material and light no longer do; 1 does without",
    )


class RateSettings(_Section):
    """Adam's learning rates, at the start; the decays are the factors reached at the end. Position is in scene radii."""

    position: float = Field(ge=0)
    rotation: float = Field(ge=0)
    scale: float = Field(ge=0)
    opacity: float = Field(ge=0)
    sh_dc: float = Field(ge=0)
    sh_rest: float = Field(ge=0)
    residual: float = Field(ge=0)
    albedo: float = Field(ge=0)
    metallic: float = Field(ge=0)
    roughness: float = Field(ge=0)
    indirect_dc: float = Field(ge=0)
    indirect_rest: float = Field(ge=0)
    environment: float = Field(ge=0)
    exposure: float = Field(ge=0)
    decay: float = Field(gt=0, le=1, description="every rate's factor at the end of the training, but the position's")
    position_decay: float = Field(gt=0, le=1, description="the position's, reached at `position_until`")
    position_until: float = Field(gt=0, le=1, description="part of the training after which it stays")


RATES = tuple(name for name in RateSettings.model_fields if not name.startswith(("decay", "position_")))
"""The rates among them."""


class LossSettings(_Section):
    dssim: float = Field(ge=0, le=1, description="λ of (1 − λ) L1 + λ D-SSIM")
    normal: float = Field(ge=0, description="weight of normal consistency with the depth")
    smooth: float = Field(ge=0, description="weight of edge-aware normal smoothness")
    even: float = Field(ge=0, description="weight of edge-aware smoothness of metallic and roughness")
    alpha: float = Field(ge=0, description="weight of the mask, where there is one")
    metallic: float = Field(
        ge=0, description="weight, at the end, of a metallic that is neither 0 nor 1; and of metals too dark for any"
    )
    matte: float = Field(ge=0, description="weight of roughness above 0.3: a surface is matte where photos say so")
    light: float = Field(ge=0, description="weight of the light's being neutral on the whole")
    exposure: float = Field(ge=0, description="weight of a photo's being exposed as most are")


class NeedsSettings(_Section):
    """What a scene may do without. `auto` measures whether it does (refgs.train.needs), `on` keeps it, `off` leaves it out."""

    views: Need = Field(description="photos that are another's twin, taken from where that was")
    outside: Need = Field(description="pixels beyond the mask, but for some about it")
    initial: Need = Field(description="the stage in which each surfel is shaded by itself")
    specular: Need = Field(description="what surfaces mirror; without it they are matte")
    iterations: Need = Field(description="a fifth of them, where nothing is mirrored")
    reflections: Need = Field(description="of the object in itself: its mesh, rays, and harmonics of its light")
    light: Need = Field(description="texels of the light finer than its blurred image on the object")
    degrees: Need = Field(description="harmonics of the higher degrees, of what `residual` learns")
    constants: Need = Field(
        description="columns of splats.ply for metallic and roughness where all surfels have the same"
    )


class DensifySettings(_Section):
    start: float = Field(ge=0, le=1, description="part of the training after which surfels are added")
    stop: float = Field(ge=0, le=1, description="part of the training after which no more are")
    every: int = Field(ge=1, description="iterations")
    gradient: float = Field(ge=0, description="mean gradient per pixel of motion above which a surfel is divided")
    prune_opacity: float = Field(ge=0, lt=1, description="surfels fainter than this are removed")
    reset_every: int = Field(
        ge=0, description="iterations between making all surfels faint; 0 never does, nor after `stop`"
    )


class PropagationSettings(_Section):
    """Material-aware normal propagation (paper §3.3): mirrors grow over what surrounds them, now and then."""

    every: int = Field(ge=0, description="iterations; 0 does without")
    stop: float = Field(ge=0, le=1, description="part of the training after which there is no more of it")
    metallic: float = Field(ge=0, le=1, description="of surfels that grow, at the least")
    roughness: float = Field(ge=0, le=1, description="of surfels that grow, at the most")
    growth: float = Field(ge=1, description="factor of their size")
    opacity: float = Field(gt=0, lt=1, description="of all surfels then, at the least")
    rest: int = Field(ge=0, description="iterations for which opacity then stays as it is")


class MeshSettings(_Section):
    resolution: int = Field(ge=16, le=1024, description="voxels along each side of the fused volume")
    triangles: int = Field(ge=100, le=10_000_000)
    texture: int = Field(ge=64, le=8192, description="side of the baked textures, in pixels")


class Settings(_Section):
    """Every number of a run. All are in the preset; there are no defaults in the code."""

    region: RegionSettings
    image: ImageSettings
    render: RenderSettings
    surfels: SurfelSettings
    environment: EnvironmentSettings
    light: LightSettings
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


SHORT = {"primitive": "surfels.primitive"} | {
    key: f"render.{key}" for key in RenderSettings.model_fields
}  # keys that `--set` takes without their section


def preset_names() -> list[str]:
    """Names of the presets that come with the program."""
    return sorted(file.stem for file in PRESETS.glob("*.toml"))


def load_settings(preset: str, changes: list[str] = ()) -> Settings:
    """Settings from a preset's name or a TOML file, with `section.key=value` changes.

    A file may start from another with `base = "NAME"`. Raises InputError with the key and what it may be.
    """
    tables = _read_preset(preset)
    for change in changes:
        key, equals, value = change.partition("=")
        key = SHORT.get(key.strip(), key.strip())
        section, dot, name = key.partition(".")
        if not equals or not dot:
            raise InputError(f"--set {change}: write it as section.key=value, e.g. train.iterations=2000")
        if not isinstance(tables.setdefault(section, {}), dict):
            raise InputError(f"--set {change}: there is no section {section}")
        tables[section][name] = _parse(value)
    return validate(tables, preset)


def recorded_settings(tables: dict[str, Any], source: str) -> Settings:
    """Settings that a run wrote down; what the program did not know of yet is as in the standard preset."""
    # All light stood in the world, no photo had an exposure, what was left over was not learned, and all was held to be needed.
    still = {"light": {"frame": "world", "exposure": "off"}, "residual": {"start": 1.0}}
    still["needs"] = dict.fromkeys(NeedsSettings.model_fields, "on")
    return validate(_merge(_merge(_read_preset("standard"), still), tables), source)


def validate(tables: dict[str, Any], source: str) -> Settings:
    """Settings from nested tables. Raises InputError naming the first key that is wrong and what it may be."""
    try:
        return Settings.model_validate(tables)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _known_keys(first["loc"][:-1])
            raise InputError(f"{source}: unknown key {key}; known here: {', '.join(known)}") from None
        if first["type"] == "missing":
            raise InputError(f'{source}: {key} is missing; add it, or start the file with base = "standard"') from None
        if first["type"] == "value_error":
            raise InputError(f"{source}: {key}: {first['ctx']['error']}") from None
        raise InputError(f"{source}: {key} = {first['input']!r}: {first['msg'].lower()}") from None


def _known_keys(location: tuple) -> list[str]:
    model = Settings
    for part in location:
        model = model.model_fields[part].annotation
    return list(model.model_fields)


def _parse(value: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value.strip()  # a bare word is a string


def _read_preset(preset: str) -> dict[str, Any]:
    file = PRESETS / f"{preset}.toml" if preset in preset_names() else Path(preset)
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"no preset {preset}: take one of {', '.join(preset_names())}, or a TOML file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
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
