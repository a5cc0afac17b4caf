"""The process that runs open3d's Poisson reconstruction, which may crash or hang, and must not take others along.

Kept apart from `avatar.export.meshing` so that the worker imports numpy and open3d only.
"""

from __future__ import annotations

import contextlib
from multiprocessing.connection import Connection

import numpy as np

FAILED = b"failed"
SOLVED = b"solved"
READY = b"ready"


def serve(connection: Connection, memory_bytes: int) -> None:
    """Answers jobs until the other end closes: points and normals in, vertices and faces out, as raw bytes.

    A job is three messages: float64 points, float64 normals, int32 depth. An answer is one of
    ``[SOLVED, float64 vertices, int32 faces]`` and ``[FAILED, UTF-8 reason]``. Nothing is pickled.

    Args:
        connection: this end of a two-way pipe.
        memory_bytes: address space the worker may take, where the system can limit it; 0 for no limit.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        _answer(connection, FAILED, str(error).encode())
        return
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    if memory_bytes:
        _limit_memory(memory_bytes)
    _answer(connection, READY)
    with contextlib.suppress(EOFError, KeyboardInterrupt):
        while True:
            points, normals = (
                np.frombuffer(bytearray(connection.recv_bytes()), np.float64).reshape(-1, 3) for _ in range(2)
            )
            depth = int(np.frombuffer(connection.recv_bytes(), np.int32)[0])
            try:
                cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
                cloud.normals = open3d.utility.Vector3dVector(normals)
                # One thread: with more, open3d is neither repeatable nor always alive (its issues 6828, 2117).
                mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
                vertices = np.asarray(mesh.vertices, np.float64)
                faces = np.asarray(mesh.triangles, np.int32)
            except (RuntimeError, MemoryError) as error:
                _answer(connection, FAILED, str(error).encode())
            else:
                _answer(connection, SOLVED, vertices.tobytes(), faces.tobytes())


def _answer(connection: Connection, *parts: bytes) -> None:
    for part in parts:
        connection.send_bytes(part)


def _limit_memory(memory_bytes: int) -> None:
    try:
        import resource
    except ImportError:  # not a POSIX system
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    allowed = memory_bytes if hard == resource.RLIM_INFINITY else min(memory_bytes, hard)
    resource.setrlimit(resource.RLIMIT_AS, (allowed, hard))
