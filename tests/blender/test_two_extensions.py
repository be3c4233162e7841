"""Test the two extensions as Blender installs them from a repository that its own tool generates: RefGS alone, and with its trainer."""

import ast
import hashlib
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import pytest

from refgs.formats.gltf import write_glb
from tests.makers.box import textured_box
from tests.makers.still_life import add_mesh_light_and_photos, write_still_life

ROOT = Path(__file__).resolve().parents[2]
TOOL = Path(bpy.utils.resource_path("LOCAL"), "scripts", "addons_core", "bl_pkg", "cli", "blender_ext.py")
# Modules that reach the network, run other programs, or install packages.
REACHING = {
    "asyncio",
    "ensurepip",
    "ftplib",
    "http",
    "pip",
    "requests",
    "smtplib",
    "socket",
    "ssl",
    "subprocess",
    "urllib",
}
# Begins each program: `on` and `off` enable and disable an extension, `ours` lists all that is registered of both.
PRELUDE = """
import sys
import bpy
import addon_utils

HERE = {folder!r}
for name in "ab":
    bpy.context.preferences.extensions.repos.new(name=name, module=name, custom_directory=HERE + "/" + name)
FIRST, SECOND = "bl_ext.a.refgs", "bl_ext.b.refgs_trainer"


def on(module):
    assert addon_utils.enable(module, default_set=True), module


def off(module):
    addon_utils.disable(module, default_set=True)


def preferences(module):
    return bpy.context.preferences.addons[module].preferences


def problem():
    return sys.modules[SECOND + ".joining"].problem()


def ours():
    found = {{name for name in dir(bpy.types) if "refgs" in name.lower()}} | {{"ops " + name for name in dir(bpy.ops.refgs)}}
    for kind in (bpy.types.Scene, bpy.types.WindowManager, bpy.types.Object):
        found |= {{kind.__name__ + " " + name for name in dir(kind) if "refgs" in name}}
    for name in dir(bpy.types):
        functions = getattr(getattr(getattr(bpy.types, name), "draw", None), "_draw_funcs", ())
        functions = [function for function in functions if function.__name__ != "draw"]  # it is the class's own
        found |= {{f"{{name}} {{function.__module__}}" for function in functions if "refgs" in function.__module__}}
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        for function in functions if isinstance(functions, list) else ():
            found |= {{f"{{name}} {{function.__module__}}"}} if "refgs" in function.__module__ else set()
    return found


"""


def tool(*arguments):
    """Run Blender's tool for extensions. Returns its exit status and its output."""
    words = [sys.executable, TOOL, *arguments]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.returncode, done.stdout


@pytest.fixture(scope="module")
def repository(tmp_path_factory):
    """Build both extensions, without the trainer's packages, and generate a repository of them. Returns its folder."""
    folder = tmp_path_factory.mktemp("repository")
    subprocess.run([sys.executable, ROOT / "scripts" / "build_extension.py", folder, "--bare"], check=True)
    status, said = tool("server-generate", "--repo-dir", folder)
    assert status == 0 and "found 2 packages" in said
    return folder


def install(repository, folder, name):
    """Install an extension from a repository into the folder of a local one. Returns the tool's exit status and its output."""
    folder.mkdir()
    url = ("--remote-url", (repository / "index.json").as_uri(), "--local-dir", folder)
    assert tool("sync", *url)[0] == 0
    python = ".".join(map(str, sys.version_info[:3]))
    return tool(
        "install", *url, "--blender-version", ".".join(map(str, bpy.app.version)), "--python-version", python, name
    )


@pytest.fixture
def installed(repository, tmp_path):
    """Install both extensions, each from a repository of its own. Returns the folder of the local repositories, a and b."""
    for name, extension in (("a", "refgs"), ("b", "refgs_trainer")):
        status, said = install(repository, tmp_path / name, extension)
        assert status == 0, said
    return tmp_path


def run(folder, program):
    """Run a program in a Blender of its own, which has the repositories of `installed`. Returns what it prints."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment |= {"BLENDER_USER_RESOURCES": str(folder / "user"), "PYTHONDONTWRITEBYTECODE": "1"}
    end = "print('did it all', flush=True)\nimport os\nos._exit(0)"  # Blender's own clean-up at exit can hang
    code = f"{PRELUDE.format(folder=str(folder))}{program}\n{end}"
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert "did it all" in done.stdout and "Traceback" not in done.stderr, done.stdout + done.stderr
    return done.stdout


def test_refgs_alone_is_what_extensions_blender_org_takes(repository):
    """Check the written rules that can be checked by reading: no network, no other program, no change of module paths, small, text only."""
    archive = next(repository.glob("refgs-*.zip"))
    contents = zipfile.ZipFile(archive)
    assert archive.stat().st_size < 1e6
    example = {name for name in contents.namelist() if name.startswith("refgs_addon/example/jar/")}
    assert {Path(name).name for name in example} >= {
        "splats.ply",
        "mesh.glb",
        "environment.exr",
        "cameras.json",
        "run.toml",
    }
    assert {Path(name).suffix for name in {*contents.namelist()} - example} == {".py", ".md", ".toml", ""}
    reaching, paths = {}, []
    for name in contents.namelist():
        for node in ast.walk(ast.parse(contents.read(name))) if name.endswith(".py") else ():
            named = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            named += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            if found := REACHING & {module.split(".")[0] for module in named}:
                reaching[name] = found
            if isinstance(node, ast.Attribute) and node.attr in ("path", "meta_path", "path_hooks", "__path__"):
                paths += [name] if isinstance(node.value, ast.Name) and node.value.id == "sys" else []
    assert reaching == {"refgs_addon/jobs.py": {"subprocess"}}  # it starts another Blender, which renders
    assert paths == [] and not any(b"sys.path" in contents.read(name) for name in contents.namelist() if ".py" in name)
    manifest = tomllib.loads(contents.read("blender_manifest.toml").decode())
    assert manifest["permissions"].keys() == {"files"} and "wheels" not in manifest
    for extension in repository.glob("*.zip"):
        texts = tomllib.loads(zipfile.ZipFile(extension).read("blender_manifest.toml").decode())
        for text in (texts["tagline"], *texts["permissions"].values()):
            assert len(text) <= 64 and text[-1].isalnum()


def test_both_have_the_version_of_the_package(repository):
    listed = json.loads((repository / "index.json").read_text())["data"]
    package = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {extension["id"]: extension["version"] for extension in listed} == dict.fromkeys(
        ("refgs", "refgs_trainer"), package["version"]
    )


def test_the_repository_has_the_hashes_that_blender_checks(repository, tmp_path):
    for listed in json.loads((repository / "index.json").read_text())["data"]:
        data = (repository / listed["archive_url"]).read_bytes()
        assert listed["archive_hash"] == f"sha256:{hashlib.sha256(data).hexdigest()}"
    forged = tmp_path / "forged"
    forged.mkdir()
    for file in repository.iterdir():
        data = bytearray(file.read_bytes())
        data[-1] ^= file.suffix == ".zip"
        (forged / file.name).write_bytes(data)
    status, said = install(forged, tmp_path / "a", "refgs")
    assert status != 0 or not (tmp_path / "a" / "refgs").exists()
    assert "mismatch" in said, said


def test_website_and_maintainer_are_given_at_the_build(tmp_path):
    facts = {"website": "https://refgs.example", "maintainer": "Somebody <somebody@refgs.example>"}
    words = [word for key, value in facts.items() for word in (f"--{key}", value)]
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "build_extension.py", tmp_path, "--bare", *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "wants" not in done.stdout
    for archive in tmp_path.glob("*.zip"):
        assert tomllib.loads(zipfile.ZipFile(archive).read("blender_manifest.toml").decode()).items() >= facts.items()


def test_refgs_works_alone(installed):
    write = write_still_life(installed / "still")
    add_mesh_light_and_photos(write)
    write_glb(write / "mesh.glb", *textured_box())
    said = run(
        installed,
        """
on(FIRST)
bpy.ops.wm.read_homefile(use_empty=True)
ops, out = bpy.ops.refgs, HERE + "/out "
assert ops.import_example() == {"FINISHED"} and "RefGS jar" in bpy.data.collections
assert ops.import_run(directory=HERE + "/still/") == {"FINISHED"}
ops.add_edit(where="Everywhere", material="Gold")
ops.relight(filepath=HERE + "/still/environment.exr", rotation=1.0, strength=2.0)
ops.delete_splats(splats="still splats")
ops.restore_splats(splats="still splats")
bpy.context.view_layer.objects.active = bpy.data.objects["still mesh"]
for kind, ending in (("splats", ".ply"), ("mesh", ".glb"), ("mesh_usd", ".usdc"), ("mesh_fbx", ".fbx"), ("light", ".exr")):
    addon_utils.enable("io_scene_fbx")
    assert getattr(ops, "export_" + kind)(filepath=out + kind + ending) == {"FINISHED"}
assert ops.apply_edits(filepath=HERE + "/edited") == {"FINISHED"}
hooks = sys.modules[FIRST + ".refgs_addon.hooks"]
assert not hooks.has_trainer() and not any("trainer" in name for name in sys.modules if "refgs" in name)
print(sorted(name for name in ours() if "train" in name.lower()))
""",
    )
    assert "[]" in said
    for name in (
        "out splats.ply",
        "out mesh.glb",
        "out mesh_usd.usdc",
        "out mesh_fbx.fbx",
        "out light.exr",
        "edited/mesh.glb",
    ):
        assert (installed / name).stat().st_size > 0


def test_enabled_and_disabled_in_any_order_nothing_is_left(installed):
    run(
        installed,
        """
before = ours()
on(FIRST)
alone = ours()
on(SECOND)
both = ours()
assert {"REFGS_PT_train", "REFGS_PT_many", "ops install_trainer", "ops hint"} <= both - alone and problem() == ""
off(SECOND)
assert ours() == alone, ours() ^ alone
assert not [name for name in sys.modules if name.startswith(FIRST) and "trainer" in name]
off(FIRST)
assert ours() == before, ours() ^ before
on(SECOND)
waiting = ours()
assert waiting - before == {"REFGS_PT_no_trainer"}
for _ in range(2):
    on(FIRST)
    assert ours() == both, ours() ^ both
    off(FIRST)
    assert ours() == waiting, ours() ^ waiting
for name in [name for name in sys.modules if name.startswith(FIRST)]:
    del sys.modules[name]  # as Blender does when it updates an extension
on(FIRST)
assert ours() == both
bpy.ops.wm.read_homefile(use_empty=True)
assert ours() == both
bpy.utils.load_scripts(reload_scripts=True)
assert ours() == both, ours() ^ both
for module in (FIRST, SECOND):
    off(module)
assert ours() == before
on(SECOND)
on(FIRST)
bpy.ops.wm.read_factory_settings()
assert ours() == before, ours() ^ before
""",
    )


def test_why_the_trainer_is_not_there_is_said_in_one_line(installed):
    run(
        installed,
        """
import pathlib
on(SECOND)
assert problem() == "RefGS is disabled: enable it in Preferences > Add-ons", problem()
joining = sys.modules[SECOND + ".joining"]
version = joining._version(joining.HERE)
manifest = pathlib.Path(HERE, "a", "refgs", "blender_manifest.toml")
own = manifest.read_text()
manifest.write_text(own.replace(version, "0.1.9"))
on(FIRST)
assert problem() == f"RefGS 0.1.9 and its trainer {version} do not fit: update both", problem()
off(FIRST)
manifest.write_text(own)
on(FIRST)
assert problem() == ""
off(FIRST)
hooks = pathlib.Path(HERE, "a", "refgs", "refgs_addon", "hooks.py")
hooks.rename(HERE + "/hooks.py")  # as in the last release that had the trainer inside
assert not joining._fits(manifest.parent)
manifest.parent.rename(HERE + "/elsewhere")
addon_utils.modules_refresh()
assert problem() == f"RefGS is missing: install that extension, version {version}", problem()
""",
    )


def test_the_preferences_of_the_one_extension_of_before_are_kept(installed):
    """Check that the trainer's extension takes over preferences that RefGS had, and uses a trainer in RefGS's folder."""
    now, before = installed / "a" / "refgs", installed / "a" / "now"
    now.rename(before)
    now.mkdir()
    (now / "blender_manifest.toml").write_bytes((before / "blender_manifest.toml").read_bytes())
    names = "".join(f"    {name}: bpy.props.StringProperty()\n" for name in ("python", "hdris", "mask_model"))
    (now / "__init__.py").write_text(
        f"import bpy\n\n\nclass Preferences(bpy.types.AddonPreferences):\n    bl_idname = __package__\n{names}\n\n"
        "def register():\n    bpy.utils.register_class(Preferences)\n\n\n"
        "def unregister():\n    bpy.utils.unregister_class(Preferences)\n"
    )
    run(
        installed,
        """
on(FIRST)
for name in ("python", "hdris", "mask_model"):
    setattr(preferences(FIRST), name, "/my/" + name)
bpy.ops.wm.save_userpref()
""",
    )
    now.rename(installed / "old")
    before.rename(now)
    again = "bpy.ops.wm.read_userpref()\n"
    run(installed, again + "assert preferences(FIRST).hdris == '/my/hdris'\nbpy.ops.wm.save_userpref()")
    run(
        installed,
        again
        + """
import pathlib
on(SECOND)
found = preferences(SECOND)
assert (found.python, found.mask_model, preferences(FIRST).hdris) == ("/my/python", "/my/mask_model", "/my/hdris")
found.python = found.mask_model = ""
off(SECOND)
on(SECOND)
assert (preferences(SECOND).python, preferences(SECOND).mask_model) == ("", ""), "they are taken over once"
trainer = sys.modules[FIRST + ".refgs_addon.trainer"].preferences
old = pathlib.Path(bpy.utils.extension_path_user(FIRST, path="trainer"))
assert trainer.home() == pathlib.Path(bpy.utils.extension_path_user(SECOND, path="trainer")) != old
old.mkdir(parents=True)
(old / "installed").write_text("0.1.0")
assert trainer.home() == old and trainer.set_up()
""",
    )
