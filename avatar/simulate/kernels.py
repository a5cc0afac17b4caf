"""Warp kernels of the simulator: distances, contacts and visibility. Imported only where warp is at hand.

A module of its own because warp compiles a module as a whole, again after every edit.
"""

import warp as wp

Floats, Vectors, Matrices, Flags = (wp.array(dtype=kind) for kind in (float, wp.vec3, wp.mat33, wp.uint8))


@wp.kernel
def signed_distances(mesh: wp.uint64, points: Vectors, reach: float, distances: Floats):
    """Distance of each point to a closed mesh, negative inside; ``reach`` where nothing is nearer."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_normal(mesh, points[i], reach)
    distances[i] = reach
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distances[i] = query.sign * wp.length(points[i] - nearest)


@wp.kernel
def find_contacts(
    mesh: wp.uint64, positions: Vectors, reach: float, points: Vectors, normals: Vectors, drifts: Vectors
):
    """Nearest collider point of each particle, the outward direction there and how far it moved this step.

    A particle out of reach gets a zero normal.
    """
    i = wp.tid()
    normals[i] = wp.vec3(0.0)
    query = wp.mesh_query_point_sign_normal(mesh, positions[i], reach)
    if query.result:
        point = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        away = positions[i] - point
        distance = wp.length(away)
        normal = wp.mesh_eval_face_normal(mesh, query.face)
        if distance > 5.0e-4:
            normal = away * (query.sign / distance)
        points[i] = point
        normals[i] = normal
        drifts[i] = wp.mesh_eval_velocity(mesh, query.face, query.u, query.v)


@wp.kernel
def push_apart(
    positions: Vectors,
    previous: Vectors,
    points: Vectors,
    normals: Vectors,
    drifts: Vectors,
    anchors: Vectors,
    anchor_stiffness: Floats,
    thickness: float,
    friction: float,
    stiffness: float,
    creep: float,
    forces: Vectors,
    hessians: Matrices,
):
    """Adds anchor springs, contact and lagged Coulomb friction (smooth below ``creep`` metres a step)."""
    i = wp.tid()
    x = positions[i]
    force = anchor_stiffness[i] * (anchors[i] - x)
    hessian = wp.identity(n=3, dtype=float) * anchor_stiffness[i]
    normal = normals[i]
    depth = thickness - wp.dot(x - points[i], normal)
    if wp.length_sq(normal) > 0.5 and depth > 0.0:
        across = wp.outer(normal, normal)
        slip = x - previous[i] - drifts[i]
        slip -= wp.dot(slip, normal) * normal
        drag = friction * stiffness * depth / wp.max(wp.length(slip), creep)
        force += stiffness * depth * normal - drag * slip
        hessian += stiffness * across + drag * (wp.identity(n=3, dtype=float) - across)
    forces[i] += force
    hessians[i] = hessian


@wp.kernel
def keep_outside(positions: Vectors, points: Vectors, normals: Vectors, thickness: float, steps: Vectors):
    """Shortens the solver's step so that no particle ends nearer to its contact plane than half the thickness."""
    i = wp.tid()
    normal = normals[i]
    if wp.length_sq(normal) > 0.5:
        height = wp.dot(positions[i] + steps[i] - points[i], normal)
        steps[i] += wp.max(0.5 * thickness - height, 0.0) * normal


@wp.kernel
def apply_hessian(hessians: Matrices, vectors: Vectors, products: Vectors):
    """Product of each particle's 3x3 block with its vector."""
    i = wp.tid()
    products[i] = hessians[i] * vectors[i]


@wp.kernel
def extrapolate(positions: Vectors, last: Vectors, momentum: float, longest: float):
    """Moves each particle on by a share of its last step, at most ``longest`` metres; remembers where it was."""
    i = wp.tid()
    x = positions[i]
    way = momentum * (x - last[i])
    last[i] = x
    positions[i] = x + way * wp.min(1.0, longest / wp.max(wp.length(way), 1.0e-9))


@wp.kernel
def hold_back(positions: Vectors, last: Vectors, share: float):
    """Goes only a share of the way from the last positions, so that contacts that push in turns come to rest."""
    i = wp.tid()
    positions[i] = last[i] + share * (positions[i] - last[i])


@wp.kernel
def tuck_under(mesh: wp.uint64, normals: Vectors, gap: float, reach: float, points: Vectors):
    """Moves points that lie above a cloth, or less than ``gap`` under it, to ``gap`` under it.

    ``normals`` are the cloth's vertex normals. Points beside the cloth, whose nearest point is on its rim, stay.
    """
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    if query.result:
        m = wp.mesh_get(mesh)
        a = normals[m.indices[3 * query.face]]
        b = normals[m.indices[3 * query.face + 1]]
        c = normals[m.indices[3 * query.face + 2]]
        normal = wp.normalize(query.u * a + query.v * b + (1.0 - query.u - query.v) * c)
        away = points[i] - wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        height = wp.dot(away, normal)
        beside = wp.length(away - height * normal)
        if height > -gap and beside < 0.4 * wp.abs(height) + 0.001:
            points[i] = points[i] - (height + gap) * normal


@wp.kernel
def see_faces(mesh: wp.uint64, origins: Vectors, normals: Vectors, views: Vectors, lift: float, seen: Flags):
    """Marks faces seen from their front by an orthographic camera: a ray towards it meets nothing."""
    i = wp.tid()
    for k in range(views.shape[0]):
        if seen[i] == wp.uint8(0) and wp.dot(normals[i], views[k]) > 0.1:
            query = wp.mesh_query_ray(mesh, origins[i] + normals[i] * lift, views[k], 10.0)
            if not query.result:
                seen[i] = wp.uint8(1)
