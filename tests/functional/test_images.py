import pytest
import torch

from pgkit.functional import quantized_pixels, shift_images


def test_shift_by_hand():
    # one row and one column repeated where the image moved away
    x = torch.arange(1, 10).reshape(1, 1, 3, 3)
    one, none = torch.tensor([1]), torch.tensor([0])
    right, up = shift_images(x, none, one), shift_images(x, -one, none)
    assert right.flatten().tolist() == [1, 1, 2, 4, 4, 5, 7, 7, 8]
    assert up.flatten().tolist() == [4, 5, 6, 7, 8, 9, 7, 8, 9]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_each_image_is_padded_and_cut_out(dtype):
    torch.manual_seed(0)
    x = torch.randint(256, (6, 3, 9, 11)).to(dtype)
    down, right = torch.randint(-4, 5, (2, 6))
    out = shift_images(x, down, right)
    assert out.dtype == dtype
    for i in range(6):
        padded = torch.nn.functional.pad(x[i : i + 1].float(), (4, 4, 4, 4), mode="replicate")[0]
        top, left = 4 - int(down[i]), 4 - int(right[i])
        assert torch.equal(out[i].float(), padded[:, top : top + 9, left : left + 11])


def test_quantized_pixels():
    # 5 bits: 255 -> 31, 8 -> 1, 7 -> 0; then noise below one level of 32, and half taken off
    torch.manual_seed(0)
    x = torch.tensor([255, 8, 7, 0], dtype=torch.uint8).repeat(4000, 1)
    out = quantized_pixels(x)
    level = torch.tensor([31.0, 1.0, 0.0, 0.0]) / 32 - 0.5
    assert (out >= level).all() and (out < level + 1 / 32).all()
    torch.testing.assert_close(out.mean(0), level + 1 / 64, atol=1e-3, rtol=0)
    assert quantized_pixels(x, 1)[:, 0].min() >= 0 > quantized_pixels(x, 1)[:, 1].max()
    with pytest.raises(TypeError, match="takes uint8 images, not torch.float32"):
        quantized_pixels(x.float())
