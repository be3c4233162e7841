import pytest
import torch

from refgs.errors import InputError
from refgs.train import checkpoint


def test_the_last_two_are_kept(tmp_path):
    folder = tmp_path / "checkpoints"
    for iteration in (10, 20, 30):
        checkpoint.save(folder, iteration, {"x": torch.full((3,), float(iteration))}, {"seconds": 1.5})
    assert checkpoint.complete(folder) == [20, 30]
    assert len(list(folder.iterdir())) == 4
    tensors, facts = checkpoint.load(folder)
    assert tensors["x"].tolist() == [30, 30, 30]
    assert facts == {"iteration": 30, "seconds": 1.5}


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
