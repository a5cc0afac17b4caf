"""Worker process of `meshing`, in which open3d may crash or hang; it imports numpy and open3d only."""

from __future__ import annotations

import contextlib
from multiprocessing.connection import Connection

import numpy as np


def serve(connection: Connection, memory_bytes: int) -> None:
    """Answers jobs, (points, normals, depth), until the other end closes: with (vertices, faces) or a reason.

    Before them it sends an empty string, or the reason why open3d cannot be imported. ``memory_bytes`` is the address
    space that the process may take, where the system can limit it; 0 for no limit.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        connection.send(str(error))
        return
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    with contextlib.suppress(ImportError):  # not a POSIX system
        import resource

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        allowed = memory_bytes if hard == resource.RLIM_INFINITY else min(memory_bytes, hard)
        if memory_bytes:
            resource.setrlimit(resource.RLIMIT_AS, (allowed, hard))
    connection.send("")
    with contextlib.suppress(EOFError, KeyboardInterrupt):
        while True:
            points, normals, depth = connection.recv()
            try:
                cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
                cloud.normals = open3d.utility.Vector3dVector(normals)
                # One thread: with more, open3d is neither repeatable nor always alive (its issues 6828, 2117).
                mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
                answer = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.triangles, np.int32)
            except (RuntimeError, MemoryError) as error:
                answer = str(error)
            connection.send(answer)
