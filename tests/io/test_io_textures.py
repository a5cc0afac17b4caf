"""Textures on disk: written and read back, refused where damaged, and in OBJ and GLB files for other programs."""

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError, DataError
from avatar.io.meshes import read_mesh
from avatar.io.npz import write_arrays
from avatar.io.textures import (
    FILES,
    Texture,
    check_texture,
    read_texture,
    smooth_normals,
    write_texture,
    write_textured_mesh,
)
from avatar.records import Mesh

Image = pytest.importorskip("PIL.Image")
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
MESH = Mesh(VERTICES, FACES)


def png(size: tuple[int, int] = (8, 8)) -> bytes:
    """An image whose upper half is red and whose lower half is blue."""
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[: size[1] // 2, :, 0], pixels[size[1] // 2 :, :, 2] = 255, 255
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, format="PNG")
    return encoded.getvalue()


UV = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.8], [0.8, 0.8], [0.1, 0.9]], np.float32)
TEXTURE = Texture(FACES, UV, np.array([[0, 1, 2], [3, 4, 5]]), png())


def test_it_comes_back_as_it_was_written(tmp_path):
    write_texture(tmp_path, TEXTURE)
    found = read_texture(tmp_path)
    assert found.png == TEXTURE.png and found.fits(MESH) and found.uv_faces.dtype == np.int64
    np.testing.assert_array_equal(found.uv, UV)
    np.testing.assert_array_equal(found.uv_faces, TEXTURE.uv_faces)
    before = [(tmp_path / name).read_bytes() for name in FILES]
    write_texture(tmp_path, TEXTURE)
    assert before == [(tmp_path / name).read_bytes() for name in FILES]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv": UV * 2}, r"uv: expected coordinates in \[0, 1\]"),
        ({"uv": UV * np.nan}, "uv: expected finite"),
        ({"uv_faces": TEXTURE.uv_faces + 1}, r"uv_faces: expected vertex indices in \[0, 6\)"),
        ({"uv_faces": TEXTURE.uv_faces[:1]}, "uv_faces: expected shape"),
        ({"faces": FACES - 1}, "faces: expected vertex indices"),
        ({"png": b"GIF89a"}, "png: expected the bytes of a PNG file"),
    ],
)
def test_what_is_no_texture_is_refused(change, message, tmp_path):
    broken = replace(TEXTURE, **change)
    with pytest.raises(AvatarError, match=message):
        check_texture(broken)
    with pytest.raises(AvatarError):
        write_texture(tmp_path, broken)
    assert not list(tmp_path.iterdir())


def test_damaged_files_are_named(tmp_path):
    with pytest.raises(DataError, match=r"texture\.npz"):
        read_texture(tmp_path)
    write_texture(tmp_path, TEXTURE)
    (tmp_path / "texture.png").write_bytes(png((16, 8)))
    with pytest.raises(DataError, match=r"texture\.png: expected the image that was written with"):
        read_texture(tmp_path)
    write_texture(tmp_path, TEXTURE)
    (tmp_path / "texture.png").unlink()
    with pytest.raises(DataError, match=r"texture\.png: there is no such file"):
        read_texture(tmp_path)
    write_texture(tmp_path, TEXTURE)
    with np.load(tmp_path / "texture.npz") as stored:
        arrays = dict(stored)
    write_arrays(tmp_path / "texture.npz", arrays | {"uv_faces": arrays["uv_faces"] + 9})
    with pytest.raises(DataError, match=r"texture\.npz: uv_faces: expected .*tools/texture\.py"):
        read_texture(tmp_path)
    write_arrays(tmp_path / "texture.npz", arrays | {"format": np.array("texture/9")})
    with pytest.raises(DataError, match="expected format texture/1, got texture/9"):
        read_texture(tmp_path)


@pytest.mark.parametrize("ending", ["obj", "glb"])
def test_another_library_reads_the_texture_right_way_up(tmp_path, ending):
    files = write_textured_mesh(tmp_path / f"mesh.{ending}", MESH, TEXTURE)
    names = {path.name for path in files}
    assert names == ({"mesh.obj", "texture.mtl", "texture.png"} if ending == "obj" else {"mesh.glb"})
    before = [path.read_bytes() for path in files]
    assert before == [path.read_bytes() for path in write_textured_mesh(files[0], MESH, TEXTURE)]
    found = trimesh.load(files[0], force="mesh", process=False)
    assert found.visual.kind == "texture" and len(found.faces) == 2
    np.testing.assert_allclose(found.triangles, VERTICES[FACES], atol=1e-6)
    np.testing.assert_allclose(found.visual.uv[found.faces], UV[TEXTURE.uv_faces], atol=1e-6)
    colors = found.visual.to_color().vertex_colors  # the upper half is red
    high = found.visual.uv[:, 1] > 0.5
    assert (colors[high][:, 0] == 255).all() and (colors[~high][:, 2] == 255).all()
    ours = read_mesh(files[0])
    np.testing.assert_allclose(ours.vertices[ours.faces], VERTICES[FACES], atol=1e-6)


def test_meshes_that_do_not_fit_are_refused(tmp_path):
    other = Mesh(VERTICES, FACES[::-1].copy())
    with pytest.raises(AvatarError, match="texture: expected one of the mesh's 2 faces"):
        write_textured_mesh(tmp_path / "mesh.obj", other, TEXTURE)
    with pytest.raises(DataError, match=r"expected a textured mesh file ending in \.obj or \.glb"):
        write_textured_mesh(tmp_path / "mesh.ply", MESH, TEXTURE)
    assert not list(tmp_path.iterdir())


def test_normals_are_unit_and_of_the_whole_mesh():
    bent = VERTICES.copy()
    bent[3] = [0, 1, 0.5]
    found = smooth_normals(np.concatenate([bent, [[5, 5, 5]]]).astype(np.float32), FACES)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found[1], [0, 0, 1], atol=1e-6)
    assert 0 < found[0] @ found[1] < 1 and found[4].tolist() == [0, 1, 0]
