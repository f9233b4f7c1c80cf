# ruff: noqa: RUF046, UP018 (Warp reads float(0.0) as a variable, 0.0 as a constant)
"""Kernels of the ray caster: hits, light and colours of one picture element.

Colours are linear light until ``_resolve`` encodes them. All lengths are in metres, all directions unit vectors.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e30)


@wp.struct
class View:
    """A pinhole camera as rays: the direction through pixel (x, y) is corner + x step_x + y step_y, normalized."""

    eye: wp.vec3
    corner: wp.vec3
    step_x: wp.vec3
    step_y: wp.vec3
    pixel: float  # angle of one pixel [rad]
    width: int
    height: int


@wp.struct
class Look:
    """Colours (linear light) and measures shared by all worlds."""

    up: wp.vec3
    side: wp.vec3
    depth: wp.vec3
    light: wp.vec3  # towards the key light
    light_spread: float  # tangent of the key light's half angle; 0 makes hard shadows
    light_turn: float  # angle between the first and the last point of the light's spiral [rad]
    centre: wp.vec3  # on the floor, below the middle of the picture
    floor_cell: float
    fade: float  # distance from the centre at which the floor melts into the background
    nudge: float  # start of shadow rays above a surface
    cable_radius: float
    goal_radius: float
    cable_glow: float  # how strongly a cable just below the body's surface shows, 0..1
    cable_sink: float  # depth below the surface at which that has fallen to a third
    chamber_glow: float  # the same for an air chamber
    chamber_sink: float
    note_glow: float  # the same for arrows, at any depth
    background: wp.vec3
    floor_even: wp.vec3
    floor_odd: wp.vec3
    goal_color: wp.vec3
    membrane_color: wp.vec3


@wp.struct
class Surface:
    """Triangles of the worlds to draw."""

    mesh: wp.array[wp.uint64]  # (world,); empty if there are none
    tri_normal: wp.array2d[int]  # (tri, 3) normal of each corner
    tri_vertex: wp.array2d[int]  # (tri, 3)
    normal: wp.array2d[wp.vec3]  # (world, normal)
    vertex_color: wp.array2d[wp.vec3]  # (1 | world, vertex)


@wp.struct
class Scene:
    """Geometry of the worlds to draw; arrays of leading size 1 are shared by all."""

    solid: Surface  # soft bodies, then rigid bodies and rods
    soft_tris: int  # triangles of soft bodies
    tri_cover: wp.array[float]  # (soft tri,) how much of its colour a triangle owes to a membrane
    chamber: Surface  # air chambers, seen through soft bodies
    note: Surface  # contacts, forces, axes: seen through everything
    floor: wp.array[wp.transform]  # (1 | world,) its z axis points up
    cable_bvh: wp.array[wp.uint64]  # (world,), over segments; empty without cables
    cable_x: wp.array2d[wp.vec3]  # (world, point)
    seg_point: wp.array[int]  # (seg,) first point
    seg_cable: wp.array[int]  # (seg,)
    cable_color: wp.array2d[wp.vec3]  # (1 | world, cable)
    goal: wp.array[wp.vec3]  # (world,); empty without goals


@wp.func
def sphere_hit(origin: wp.vec3, ray: wp.vec3, centre: wp.vec3, radius: float):
    """Distance along the ray to a sphere's front; ``FAR`` without a hit or from inside."""
    along = wp.dot(centre - origin, ray)
    gap = centre - origin - along * ray
    h = radius * radius - wp.dot(gap, gap)
    if h < 0.0:
        return FAR
    t = along - wp.sqrt(h)
    if t < 0.0:
        return FAR
    return t


@wp.func
def capsule_hit(origin: wp.vec3, ray: wp.vec3, a: wp.vec3, b: wp.vec3, radius: float):
    """Distance along the ray to the front of the capsule around the segment a b; ``FAR`` without a hit.

    The cylinder's quadratic is taken about the ray's point nearest to ``a``, which keeps float32 exact enough for thin
    capsules seen from afar.
    """
    shift = wp.dot(a - origin, ray)
    o = origin + shift * ray - a
    ab = b - a
    ab2 = wp.dot(ab, ab)
    ab_ray = wp.dot(ab, ray)
    ab_o = wp.dot(ab, o)
    qa = ab2 - ab_ray * ab_ray
    qb = ab2 * wp.dot(ray, o) - ab_o * ab_ray
    qc = ab2 * wp.dot(o, o) - ab_o * ab_o - radius * radius * ab2
    h = qb * qb - qa * qc
    if h >= 0.0 and qa > 1.0e-6 * ab2:
        t = (-qb - wp.sqrt(h)) / qa
        y = ab_o + t * ab_ray
        if y > 0.0 and y < ab2 and t + shift > 0.0:
            return t + shift
    return wp.min(sphere_hit(origin, ray, a, radius), sphere_hit(origin, ray, b, radius))


@wp.func
def lit(albedo: wp.vec3, normal: wp.vec3, ray: wp.vec3, visible: float, gloss: float, look: Look):
    """Reflected light: a sky above, a dim ground below, a key light wrapped softly round the shape, a highlight."""
    sky = 0.5 + 0.5 * wp.dot(normal, look.up)
    ambient = wp.vec3(0.21, 0.20, 0.19) * (1.0 - sky) + wp.vec3(0.44, 0.47, 0.50) * sky
    towards = wp.dot(normal, look.light)
    key = wp.clamp((towards + 0.15) / 1.15, 0.0, 1.0) * visible
    half = wp.normalize(look.light - ray)
    shine = gloss * visible * wp.pow(wp.max(wp.dot(normal, half), 0.0), 48.0)
    rim = gloss * 0.35 * wp.pow(1.0 - wp.clamp(-wp.dot(normal, ray), 0.0, 1.0), 4.0) * sky
    return wp.cw_mul(albedo, ambient + wp.vec3(0.80, 0.77, 0.72) * key) + wp.vec3(1.0, 1.0, 1.0) * (shine + rim)


@wp.func
def backdrop(ray: wp.vec3, look: Look):
    """Colour where nothing is hit: the horizon's, a little darker upwards."""
    rise = wp.clamp(wp.dot(ray, look.up), 0.0, 1.0)
    return look.background * (1.0 - 0.35 * rise)


@wp.func
def towards_light(x: float, y: float, part: float, look: Look):
    """Direction to a point of the key light's disc that holds ``part`` of its area, 0 the middle and 1 the edge.

    Points of rising ``part`` lie on a sunflower spiral. It is turned by an angle that differs evenly between
    neighbouring pixels (interleaved gradient noise, Jimenez 2014), so that few rays make a smooth penumbra.
    """
    noise = wp.frac(52.9829189 * wp.frac(0.06711056 * wp.floor(x) + 0.00583715 * wp.floor(y)))
    angle = 6.2831853 * noise + look.light_turn * part
    reach = look.light_spread * wp.sqrt(part)
    return wp.normalize(look.light + reach * (wp.cos(angle) * look.side + wp.sin(angle) * look.depth))


@wp.func
def floor_color(
    mesh: wp.uint64,
    floor: wp.transform,
    point: wp.vec3,
    ray: wp.vec3,
    distance: float,
    pixel: float,
    lamp: wp.vec3,
    look: Look,
):
    """A checker that blurs with distance and fades into the background, with the bodies' shadow."""
    up = wp.quat_rotate(wp.transform_get_rotation(floor), wp.vec3(0.0, 0.0, 1.0))
    local = wp.transform_point(wp.transform_inverse(floor), point)
    x = local[0] / look.floor_cell
    y = local[1] / look.floor_cell
    width = distance * pixel / (wp.max(wp.abs(wp.dot(ray, up)), 1.0e-3) * look.floor_cell)
    sharp = wp.clamp(1.5 - 2.0 * width, 0.0, 1.0)
    odd = float((int(wp.floor(x)) + int(wp.floor(y))) & 1)
    blend = 0.5 + (odd - 0.5) * sharp
    color = look.floor_even * (1.0 - blend) + look.floor_odd * blend
    if wp.mesh_query_ray_anyhit(mesh, point + look.nudge * up, lamp, FAR):
        color = color * 0.5
    near = wp.clamp(1.0 - wp.length(point - look.centre) / look.fade, 0.0, 1.0)
    near = near * near * (3.0 - 2.0 * near)
    return backdrop(ray, look) * (1.0 - near) + color * near


@wp.func
def surface_normal(surface: Surface, world: int, face: int, u: float, v: float, ray: wp.vec3):
    """Smooth unit normal at barycentric (u, v, 1 - u - v) of a triangle, turned towards the eye."""
    n0 = surface.normal[world, surface.tri_normal[face, 0]]
    n1 = surface.normal[world, surface.tri_normal[face, 1]]
    n2 = surface.normal[world, surface.tri_normal[face, 2]]
    normal = wp.normalize(u * n0 + v * n1 + (1.0 - u - v) * n2)
    if wp.dot(normal, ray) > 0.0:
        normal = wp.normalize(normal - 1.01 * wp.dot(normal, ray) * ray)
    return normal


@wp.func
def surface_color(surface: Surface, world: int, face: int, u: float, v: float):
    """Colour between those of a triangle's vertices."""
    paint = world % surface.vertex_color.shape[0]
    c0 = surface.vertex_color[paint, surface.tri_vertex[face, 0]]
    c1 = surface.vertex_color[paint, surface.tri_vertex[face, 1]]
    c2 = surface.vertex_color[paint, surface.tri_vertex[face, 2]]
    return u * c0 + v * c1 + (1.0 - u - v) * c2


@wp.func
def solid_color(
    scene: Scene, world: int, face: int, u: float, v: float, point: wp.vec3, ray: wp.vec3, lamp: wp.vec3, look: Look
):
    """Colour of a solid's surface, in light or in shadow."""
    normal = surface_normal(scene.solid, world, face, u, v, ray)
    albedo = surface_color(scene.solid, world, face, u, v)
    if face < scene.soft_tris:
        albedo = albedo + scene.tri_cover[face] * (look.membrane_color - albedo)
    visible = float(0.0)
    if wp.dot(normal, look.light) > -0.15:
        if not wp.mesh_query_ray_anyhit(scene.solid.mesh[world], point + look.nudge * normal, lamp, FAR):
            visible = 1.0
    return lit(albedo, normal, ray, visible, 0.30, look)


@wp.func
def over_surface(
    surface: Surface,
    world: int,
    origin: wp.vec3,
    ray: wp.vec3,
    depth: float,
    below: wp.vec3,
    glow: float,
    sink: float,
    look: Look,
):
    """Lay a surface over a colour: plainly where it is in front, fainter the deeper it lies below what is."""
    hit = wp.mesh_query_ray(surface.mesh[world], origin, ray, FAR)
    if not hit.result:
        return below
    normal = surface_normal(surface, world, hit.face, hit.u, hit.v, ray)
    color = lit(surface_color(surface, world, hit.face, hit.u, hit.v), normal, ray, 1.0, 0.15, look)
    cover = float(1.0)
    if hit.t > depth + look.nudge:
        cover = glow * wp.exp((depth - hit.t) / sink)
    return color * cover + below * (1.0 - cover)


@wp.func
def over_cables(scene: Scene, world: int, origin: wp.vec3, ray: wp.vec3, depth: float, below: wp.vec3, look: Look):
    """Lay the nearest cable over a colour: plainly where it is in front, fainter the deeper it lies in the body."""
    nearest = float(FAR)
    hit = int(-1)
    seg = int(0)
    query = wp.bvh_query_ray(scene.cable_bvh[world], origin, ray)
    while wp.bvh_query_next(query, seg, nearest):
        p = scene.seg_point[seg]
        t = capsule_hit(origin, ray, scene.cable_x[world, p], scene.cable_x[world, p + 1], look.cable_radius)
        if t < nearest:
            nearest = t
            hit = seg
    if hit < 0:
        return below
    a = scene.cable_x[world, scene.seg_point[hit]]
    b = scene.cable_x[world, scene.seg_point[hit] + 1]
    point = origin + nearest * ray
    part = wp.clamp(wp.dot(point - a, b - a) / wp.max(wp.dot(b - a, b - a), 1.0e-30), 0.0, 1.0)
    normal = wp.normalize(point - a - part * (b - a))
    albedo = scene.cable_color[world % scene.cable_color.shape[0], scene.seg_cable[hit]]
    color = lit(albedo, normal, ray, 1.0, 0.15, look)
    cover = float(1.0)
    if nearest > depth:
        cover = look.cable_glow * wp.exp((depth - nearest) / look.cable_sink)
    return color * cover + below * (1.0 - cover)


@wp.func
def over_goal(goal: wp.vec3, origin: wp.vec3, ray: wp.vec3, depth: float, below: wp.vec3, look: Look):
    """Lay the translucent goal sphere over a colour; fainter where something stands before it."""
    t = sphere_hit(origin, ray, goal, look.goal_radius)
    if t >= FAR:
        return below
    normal = wp.normalize(origin + t * ray - goal)
    rim = 1.0 - wp.clamp(-wp.dot(normal, ray), 0.0, 1.0)
    cover = 0.62 + 0.3 * rim * rim
    if t > depth:
        cover = 0.40 * cover
    return lit(look.goal_color, normal, ray, 1.0, 0.25, look) * cover + below * (1.0 - cover)


@wp.func
def radiance(scene: Scene, look: Look, view: View, world: int, x: float, y: float, part: float):
    """Light that reaches the eye through the picture point (x, y) [pixels from the top left corner].

    Shadows are those of one point of the key light, as in ``towards_light``.
    """
    ray = wp.normalize(view.corner + x * view.step_x + y * view.step_y)
    lamp = towards_light(x, y, part, look)
    color = backdrop(ray, look)
    depth = float(FAR)
    is_soft = bool(True)  # what is hit first; chambers in the air count as in the open
    hit = wp.mesh_query_ray(scene.solid.mesh[world], view.eye, ray, FAR)
    if hit.result:
        depth = hit.t
        is_soft = hit.face < scene.soft_tris
    floor = scene.floor[world % scene.floor.shape[0]]
    up = wp.quat_rotate(wp.transform_get_rotation(floor), wp.vec3(0.0, 0.0, 1.0))
    down = wp.dot(ray, up)
    to_floor = float(FAR)
    if down < -1.0e-6:
        to_floor = wp.dot(wp.transform_get_translation(floor) - view.eye, up) / down
    if to_floor > 0.0 and to_floor < depth:
        depth = to_floor
        is_soft = False
        mesh = scene.solid.mesh[world]
        color = floor_color(mesh, floor, view.eye + depth * ray, ray, depth, view.pixel, lamp, look)
    elif hit.result:
        color = solid_color(scene, world, hit.face, hit.u, hit.v, view.eye + depth * ray, ray, lamp, look)
    if scene.chamber.mesh.shape[0] > 0:
        glow = wp.where(is_soft, look.chamber_glow, 0.0)
        color = over_surface(scene.chamber, world, view.eye, ray, depth, color, glow, look.chamber_sink, look)
    if scene.cable_bvh.shape[0] > 0:
        color = over_cables(scene, world, view.eye, ray, depth, color, look)
    if scene.goal.shape[0] > 0:
        color = over_goal(scene.goal[world], view.eye, ray, depth, color, look)
    if scene.note.mesh.shape[0] > 0:
        color = over_surface(scene.note, world, view.eye, ray, depth, color, look.note_glow, FAR, look)
    return color


@wp.func
def encoded(c: float):
    """Byte value (sRGB) of a linear-light component."""
    s = wp.clamp(c, 0.0, 1.0)
    if s <= 0.0031308:
        s = 12.92 * s
    else:
        s = 1.055 * wp.pow(s, 1.0 / 2.4) - 0.055
    return wp.uint8(int(255.0 * s + 0.5))


@wp.func
def contrast(a: wp.vec3, b: wp.vec3):
    """Largest difference of two colours' components, on a scale near to the eye's (square roots)."""
    x = wp.abs(wp.sqrt(wp.max(a[0], 0.0)) - wp.sqrt(wp.max(b[0], 0.0)))
    y = wp.abs(wp.sqrt(wp.max(a[1], 0.0)) - wp.sqrt(wp.max(b[1], 0.0)))
    z = wp.abs(wp.sqrt(wp.max(a[2], 0.0)) - wp.sqrt(wp.max(b[2], 0.0)))
    return wp.max(x, wp.max(y, z))


@wp.kernel
def _gather(
    node_of: wp.array[int],
    node_x_in: wp.array2d[wp.vec3],
    # Workspace out
    vertex_x_out: wp.array2d[wp.vec3],
):
    world, vertex = wp.tid()
    vertex_x_out[world, vertex] = node_x_in[world, node_of[vertex]]


@wp.kernel
def _carry(
    vertex_local: wp.array[wp.vec3],
    vertex_rigid: wp.array[int],
    rigid_pose_in: wp.array2d[wp.transform],
    first: int,
    # Workspace out
    vertex_x_out: wp.array2d[wp.vec3],
):
    world, vertex = wp.tid()
    pose = rigid_pose_in[world, vertex_rigid[vertex]]
    vertex_x_out[world, first + vertex] = wp.transform_point(pose, vertex_local[vertex])


@wp.kernel
def _put(
    x_in: wp.array2d[wp.vec3],
    first: int,
    # Workspace out
    vertex_x_out: wp.array2d[wp.vec3],
):
    world, vertex = wp.tid()
    vertex_x_out[world, first + vertex] = x_in[world, vertex]


@wp.kernel
def _smooth_normals(
    tri_vertex: wp.array2d[int],
    normal_tri_start: wp.array[int],
    normal_tri: wp.array[int],
    vertex_x_in: wp.array2d[wp.vec3],
    # Workspace out
    normal_out: wp.array2d[wp.vec3],
):
    world, item = wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(normal_tri_start[item], normal_tri_start[item + 1]):
        tri = normal_tri[k]
        a = vertex_x_in[world, tri_vertex[tri, 0]]
        b = vertex_x_in[world, tri_vertex[tri, 1]]
        c = vertex_x_in[world, tri_vertex[tri, 2]]
        total += wp.cross(b - a, c - a)  # weighted by area
    normal_out[world, item] = wp.normalize(total)


@wp.kernel
def _segment_boxes(
    seg_point: wp.array[int],
    cable_x_in: wp.array2d[wp.vec3],
    radius: float,
    # Workspace out
    seg_low_out: wp.array2d[wp.vec3],
    seg_high_out: wp.array2d[wp.vec3],
):
    world, seg = wp.tid()
    a = cable_x_in[world, seg_point[seg]]
    b = cable_x_in[world, seg_point[seg] + 1]
    grow = wp.vec3(radius, radius, radius)
    seg_low_out[world, seg] = wp.min(a, b) - grow
    seg_high_out[world, seg] = wp.max(a, b) + grow


@wp.kernel
def _trace(
    scene: Scene,
    look: Look,
    view: View,
    first_row: int,
    # Workspace out
    light_out: wp.array3d[wp.vec3],
):
    row, x = wp.tid()
    world = (first_row + row) // view.height
    y = (first_row + row) % view.height
    light_out[world, y, x] = radiance(scene, look, view, world, float(x) + 0.5, float(y) + 0.5, 1.0)


@wp.kernel
def _resolve(
    scene: Scene,
    look: Look,
    view: View,
    first_row: int,
    samples: int,
    threshold: float,
    light_in: wp.array3d[wp.vec3],
    # Workspace out
    image_out: wp.array3d[wp.vec3ub],
):
    row, x = wp.tid()
    world = (first_row + row) // view.height
    y = (first_row + row) % view.height
    color = light_in[world, y, x]
    # Pixels that differ from a neighbour hold an edge or a penumbra and get more rays. Many rays make a wide penumbra,
    # whose single rays may agree all around a pixel: then farther neighbours are asked, too.
    edge = float(0.0)
    reach = int(1)
    if samples >= 8:
        reach = 4
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            beside = light_in[world, wp.clamp(y + j, 0, view.height - 1), wp.clamp(x + i, 0, view.width - 1)]
            edge = wp.max(edge, contrast(color, beside))
    if samples > 1 and edge > threshold:
        color = wp.vec3(0.0, 0.0, 0.0)
        for k in range(samples):
            # The additive recurrence of the plastic number spreads points evenly over the pixel (Roberts 2018).
            px = float(x) + wp.frac(0.5 + 0.7548776662 * float(k))
            py = float(y) + wp.frac(0.5 + 0.5698402910 * float(k))
            color += radiance(scene, look, view, world, px, py, (float(k) + 0.5) / float(samples))
        color = color / float(samples)
    image_out[world, y, x] = wp.vec3ub(encoded(color[0]), encoded(color[1]), encoded(color[2]))
