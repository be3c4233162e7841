import os
from pathlib import Path

import pytest
import tomli_w
import torch
from safetensors.torch import load_file, save_file

from refgs.errors import InputError
from refgs.model.surfels import raw_metallic
from refgs.render.baselines import LINEAR
from refgs.train.keep import checkpoint
from refgs.train.keep.earlier import RENAMED, as_of_today
from refgs.train.material.metals import HELD, Metals
from tests.makers.mutants import put_link
from tests.makers.training import put, trainer


def test_the_last_two_are_kept(tmp_path):
    folder = tmp_path / "checkpoints"
    for iteration in (10, 20, 30):
        checkpoint.save(folder, iteration, {"x": torch.full((3,), float(iteration))}, {"seconds": 1.5})
    assert checkpoint.complete(folder) == [20, 30]
    assert len(list(folder.iterdir())) == 4
    tensors, facts = checkpoint.load(folder)
    assert tensors["x"].tolist() == [30, 30, 30]
    assert facts == {"iteration": 30, "seconds": 1.5}


def test_one_that_is_open_is_removed_later(tmp_path, monkeypatch):
    """Refuse to remove files, as Windows does while a program reads them."""

    def refuse(file, missing_ok=False):
        if file.suffix == ".safetensors":
            raise PermissionError(13, "Access is denied", str(file))
        unlink(file, missing_ok)

    unlink, folder = Path.unlink, tmp_path / "checkpoints"
    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", refuse)
        for iteration in (10, 20, 30, 40):
            checkpoint.save(folder, iteration, {"x": torch.full((3,), float(iteration))}, {})
    assert checkpoint.complete(folder) == [30, 40]
    checkpoint.save(folder, 50, {"x": torch.full((3,), 50.0)}, {})
    assert sorted(file.stem for file in folder.iterdir()) == ["00000040"] * 2 + ["00000050"] * 2


def test_half_a_checkpoint_does_not_count(tmp_path):
    checkpoint.save(tmp_path, 10, {"x": torch.zeros(1)}, {})
    (tmp_path / "00000020.safetensors").write_bytes(b"half")
    (tmp_path / "00000030.toml.tmp").write_text("iteration = 30")
    assert checkpoint.complete(tmp_path) == [10]


def test_none_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no complete checkpoint"):
        checkpoint.load(tmp_path)


def test_a_full_disk_leaves_the_previous_checkpoint_whole(small_disk):
    folder = small_disk / "checkpoints"
    checkpoint.save(folder, 10, {"x": torch.arange(1000.0)}, {})
    with pytest.raises(InputError, match=r"disk is full; the checkpoint of iteration 10 is whole"):
        checkpoint.save(folder, 20, {"x": torch.zeros(2_000_000)}, {})
    assert sorted(file.name for file in folder.iterdir()) == ["00000010.safetensors", "00000010.toml"]
    torch.testing.assert_close(checkpoint.load(folder)[0]["x"], torch.arange(1000.0))


def truncate(data, note):
    data.write_bytes(data.read_bytes()[:-7])


def empty_note(data, note):
    note.write_bytes(b"")


def half_a_note(data, note):
    note.write_bytes(note.read_bytes()[:-5])


def no_text(data, note):
    note.write_bytes(b"\xff\xfe" + note.read_bytes())


def no_data(data, note):
    data.unlink()


def not_a_number(data, note):
    data.write_bytes(data.read_bytes()[:-4] + b"\x00\x00\xc0\x7f")


def another_shape(data, note):
    save_file({"x": load_file(str(data))["x"][:2].clone()}, str(data))


def another_iteration(data, note):
    note.write_text(note.read_text().replace("iteration = 20", "iteration = 200"))


def endless_note(data, note):
    note.unlink()
    put_link(note, "/dev/zero")


def endless_data(data, note):
    data.unlink()
    put_link(data, "/dev/zero")


DAMAGES = [truncate, empty_note, half_a_note, no_text, no_data, not_a_number, another_shape, another_iteration]
DAMAGES += [endless_note, endless_data] if os.path.exists("/dev/zero") else []


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_one_is_set_aside_and_the_one_before_is_read(tmp_path, damage):
    for iteration in (10, 20):
        checkpoint.save(tmp_path, iteration, {"x": torch.full((3,), float(iteration))}, {"seconds": 1.5})
    damage(tmp_path / "00000020.safetensors", tmp_path / "00000020.toml")
    said = []
    tensors, facts = checkpoint.load(tmp_path, lambda event, facts: said.append((event, facts["what"])))
    assert tensors["x"].tolist() == [10, 10, 10] and facts == {"iteration": 10, "seconds": 1.5}
    assert len(said) == 1 and said[0][0] == "warning" and "\n" not in said[0][1]
    assert "checkpoint of iteration 20 is damaged and set aside as *.damaged" in said[0][1]
    assert checkpoint.complete(tmp_path) == [10] and (tmp_path / "00000020.toml.damaged").exists()
    checkpoint.save(tmp_path, 20, {"x": torch.zeros(1)}, {})
    assert checkpoint.load(tmp_path)[1]["iteration"] == 20


def test_without_a_whole_one_it_is_an_error(tmp_path):
    checkpoint.save(tmp_path, 10, {"x": torch.zeros(1)}, {})
    no_data(tmp_path / "00000010.safetensors", None)
    with pytest.raises(checkpoint.NoCheckpoint):
        checkpoint.load(tmp_path)


def test_one_of_an_earlier_release_has_no_hash(tmp_path):
    save_file({"x": torch.ones(2)}, str(tmp_path / "00000010.safetensors"))
    (tmp_path / "00000010.toml").write_text(tomli_w.dumps({"iteration": 10, "total": 30}))
    tensors, facts = checkpoint.load(tmp_path)
    assert tensors["x"].tolist() == [1, 1] and facts == {"iteration": 10, "total": 30}


def test_one_of_0_1_0_is_read_as_one_of_today(ball_capture, tmp_path):
    """Write a checkpoint as 0.1.0 did, which had other names and knew held surfels by their metallic, and check that nothing is lost."""
    made = trainer(ball_capture, tmp_path / "run", "cameras.poses=on", "light.exposure=on", total=40)
    for _ in range(5):
        made.step()
    held = torch.arange(made.state.learned.count) % 3 == 0
    put(made, held=held, metallic=torch.where(held, raw_metallic(HELD.metal), 0.3))
    made.state.part(Metals).found = True
    made.save()
    tensors, facts = checkpoint.load(tmp_path / "run" / "checkpoints")
    earlier = {name: value for name, value in tensors.items() if name != "parameter.held"}
    earlier |= {old: earlier.pop(new) for old, new in RENAMED.items() if new in earlier}
    old = {name: value for name, value in facts.items() if name not in ("residual", "clock", "parts")}
    old |= {"parts": facts["clock"], "metals_set": True, "poses_judged": False, "reduced": 1}
    earlier["environment"] = tensors["environment"].exp().expm1().log()  # light was the softplus of its texels
    found, known = as_of_today(earlier, old, LINEAR)
    begun_anew = {name for name in tensors if name.startswith(("means.", "adam.environment."))}
    assert tensors.keys() - begun_anew <= found.keys()
    torch.testing.assert_close(found.pop("environment"), tensors["environment"])
    assert all(torch.equal(found[name], tensors[name]) for name in found)
    assert known | {"parts": facts["parts"]} == facts | {key: old[key] for key in old.keys() - facts.keys()}
    assert all(known["parts"][name] == facts["parts"][name] for name in ("metals", "poses", "coarse"))


def test_what_a_kill_between_two_files_left_is_removed(tmp_path):
    for iteration in (10, 20, 30):
        checkpoint.save(tmp_path, iteration, {"x": torch.zeros(1)}, {})
    (tmp_path / "00000020.toml").unlink()
    checkpoint.save(tmp_path, 40, {"x": torch.zeros(1)}, {})
    assert sorted(file.stem for file in tmp_path.iterdir()) == ["00000030", "00000030", "00000040", "00000040"]
