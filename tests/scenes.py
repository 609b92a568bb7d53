"""Small scenes for the tests of the renderer, and what the oracle makes of them."""

from dataclasses import replace

import numpy as np
import reference

import diffrast as dr
from diffrast import linalg, shapes, viewing

HEIGHT, WIDTH = 48, 64
VIEW = {"fov_y": 0.65, "aspect": WIDTH / HEIGHT, "near": 1.0, "far": 15.0}
BACKGROUND = (0.1, 0.2, 0.3)


def settings(antialias=False, **options):
    return dr.RenderSettings(height=HEIGHT, width=WIDTH, antialias=antialias, **options)


# ---------------------------------------------------------------------------------------- scenes


def many_objects(background=BACKGROUND):
    """Stretched, mirrored and open objects, smooth and flat, shiny and dull, in three lights."""
    ball = shapes.icosphere(1)
    shell = shapes.icosphere(1)
    stretched = linalg.compose(
        linalg.translation((-1.3, 0.7, 0.0)),
        linalg.rotation((1, 2, 0.5), 0.7),
        linalg.scaling((1.2, 0.6, 0.9)),
    )
    mirrored = linalg.compose(
        linalg.translation((1.2, 0.6, -0.5)),
        linalg.rotation((1, 1, 0), 0.6),
        linalg.scaling((-0.7, 0.7, 0.9)),
    )
    sunk = linalg.compose(linalg.translation((0.2, -1.0, 0.4)), linalg.rotation_x(0.7))
    return dr.Scene(
        objects=[
            dr.Object(
                dr.Mesh(vertices=ball.vertices, faces=ball.faces, normals=ball.vertices),
                dr.Material(diffuse=(0.8, 0.2, 0.1), specular=(0.9, 0.9, 0.5), shininess=12.0),
                stretched,
            ),
            dr.Object(shapes.cube(), dr.Material(diffuse=(0.2, 0.7, 0.3)), mirrored),
            # A dome without normals, open to the top: its inside is seen too.
            dr.Object(
                dr.Mesh(vertices=shell.vertices, faces=open_at_the_top(shell)),
                dr.Material(
                    diffuse=(0.3, 0.4, 0.9),
                    ambient=(0.9, 0.8, 0.1),
                    specular=(0.2, 0.5, 0.3),
                    shininess=5.0,
                ),
                sunk,
            ),
        ],
        lights=[
            dr.AmbientLight((0.15, 0.1, 0.2)),
            dr.DirectionalLight(
                direction=(-0.5, -1.0, -1.5),
                ambient=(0.1, 0.1, 0.05),
                diffuse=(0.6, 0.7, 0.5),
                specular=(0.5, 0.3, 0.4),
            ),
            dr.PointLight(position=(-1.0, 2.5, 3.0), diffuse=(0.5, 0.3, 0.6)),
        ],
        background=background,
    )


def open_at_the_top(mesh):
    heights = np.asarray(mesh.vertices)[np.asarray(mesh.faces), 1]
    return np.asarray(mesh.faces)[heights.mean(axis=1) < 0.3]


def one_object(shift=(0.0, 0.0, 0.0)):
    """A shiny ball in two lights."""
    ball = shapes.icosphere(1)
    return dr.Scene(
        objects=[
            dr.Object(
                dr.Mesh(vertices=ball.vertices, faces=ball.faces, normals=ball.vertices),
                dr.Material(diffuse=(0.8, 0.2, 0.1), specular=(0.9, 0.9, 0.5), shininess=12.0),
                linalg.translation(shift),
            )
        ],
        lights=[
            dr.DirectionalLight(direction=(-0.5, -1.0, -1.5), ambient=(0.2, 0.1, 0.1)),
            dr.PointLight(position=(-1.0, 2.5, 3.0), diffuse=(0.5, 0.3, 0.6)),
        ],
        background=BACKGROUND,
    )


def room():
    """The inside of a ball of 20 faces, to be seen from within; one more face has no area."""
    ball = shapes.icosahedron(flat=False)
    faces = np.asarray(ball.faces)[:, ::-1]
    faces = np.vstack([faces, faces[0, [0, 1, 1]]])
    scene = one_object()
    mesh = dr.Mesh(vertices=2 * ball.vertices, faces=faces, normals=-ball.vertices)
    return replace(
        scene,
        objects=(replace(scene.objects[0], mesh=mesh),),
        lights=(
            dr.DirectionalLight(direction=(-0.2, 0.1, -1.0), diffuse=(0.3, 0.5, 0.7)),
            dr.PointLight(position=(0.3, 0.5, 1.0), diffuse=(0.5, 0.3, 0.6)),
        ),
    )


# --------------------------------------------------------------------------------------- cameras


def perspective(eye=(0.6, 1.2, 6.0), target=(0.0, 0.0, 0.0)):
    return dr.Camera.perspective(eye=eye, target=target, **VIEW)


def inside():
    """Sees nothing but the `room`'s walls, and has no pixel centre on the edge of one."""
    options = {"fov_y": 1.0, "aspect": WIDTH / HEIGHT, "near": 0.1, "far": 10.0}
    return dr.Camera.perspective(eye=(-0.22, 0.16, 0.16), target=(-0.4, 0.44, -0.74), **options)


def parallel():
    options = {"height": 4.1, "aspect": WIDTH / HEIGHT, "near": 1.0, "far": 15.0}
    return dr.Camera.orthographic(eye=(0.6, 1.2, 6.0), target=(0, 0, 0), **options)


def oblique():
    """A cavalier projection: parallel rays at 45 degrees to the picture."""
    window = (-2.9, 2.7, -2.1, 2.1)
    return dr.Camera.phigs(
        view_reference_point=(0.0, 0.0, 2.0),
        view_plane_normal=(0.1, 0.2, 1.0),
        view_up=(0, 1, 0),
        projection_reference_point=viewing.oblique_reference_point(window, foreshortening=1.0),
        window=window,
        view_plane_distance=-2.0,
        front=3.0,
        back=-9.0,
        projection="parallel",
    )


CAMERAS = {"perspective": perspective, "parallel": parallel, "oblique": oblique}


# ------------------------------------------------------------------------------------ the oracle


class Oracle:
    """A scene in the terms of `reference`: one mesh in the world, in float64."""

    def __init__(self, scene, view, projection):
        self.scene = scene
        self.view, self.projection = np.asarray(view, float), np.asarray(projection, float)
        meshes = [_in_world(item) for item in scene.objects]
        firsts = np.cumsum([0, *(len(positions) for positions, _, _ in meshes)])
        self.positions = np.concatenate([positions for positions, _, _ in meshes])
        self.normals = np.concatenate([normals for _, normals, _ in meshes])
        faces = [faces + first for (_, _, faces), first in zip(meshes, firsts[:-1], strict=True)]
        self.faces = np.concatenate(faces)
        self.lights = self._lights()
        self.object_of_face = np.repeat(np.arange(len(faces)), [len(part) for part in faces])

    def material(self):
        """Values of every face."""
        materials = [item.material for item in self.scene.objects]
        none = np.zeros(3)
        table = {
            "ambient": [m.ambient for m in materials],
            "diffuse": [m.diffuse for m in materials],
            "specular": [none if m.specular is None else m.specular for m in materials],
            "shininess": [m.shininess for m in materials],
        }
        return {k: np.asarray(values, float)[self.object_of_face] for k, values in table.items()}

    def _lights(self):
        kinds = {
            dr.DirectionalLight: "directional",
            dr.PointLight: "point",
            dr.SpotLight: "spot",
        }
        lights = []
        for light in self.scene.lights:
            if isinstance(light, dr.AmbientLight):
                lights.append({"type": "ambient", "ambient": np.asarray(light.color, float)})
                continue
            given = {k: v for k, v in vars(light).items() if v is not None and k != "shadow"}
            values = {k: np.asarray(v, float) for k, v in given.items()}
            lights.append({"type": kinds[type(light)], **values})
        return lights

    def fragments(self, cull_backfaces=False, samples=1):
        clip_from_world = self.projection @ self.view
        clip = np.pad(self.positions, ((0, 0), (0, 1)), constant_values=1) @ clip_from_world.T
        return reference.rasterize(clip, self.faces, HEIGHT, WIDTH, cull_backfaces, samples)

    def image(self, settings, samples=1):
        """The picture; "unlit" is what white ambient light makes of the diffuse reflectance."""
        material, lights, shading = self.material(), self.lights, settings.shading
        if shading == "unlit":
            material["ambient"] = material["diffuse"]
            lights, shading = [{"type": "ambient", "ambient": np.ones(3)}], "phong"
        background = np.asarray(self.scene.background, float)
        image = reference.render_phong(
            self.positions,
            self.normals,
            self.faces,
            self.view,
            self.projection,
            lights=lights,
            material=material,
            background=background if background.ndim == 1 else np.zeros(3),
            height=HEIGHT,
            width=WIDTH,
            samples=samples,
            shading=shading,
            cull_backfaces=settings.cull_backfaces,
        )
        if background.ndim == 3:
            face = self.fragments(settings.cull_backfaces, samples).face
            empty = (face < 0).reshape(HEIGHT, samples, WIDTH, samples).mean(axis=(1, 3))
            image = image + empty[..., None] * background
        return image

    def clear(self, samples=1, margin=0.01):
        """Pixels none of whose samples is nearly on an edge or between two surfaces."""
        fragments = self.fragments(samples=samples)
        clear = (fragments.edge_distance * samples > margin) & (fragments.depth_gap > 1e-4)
        return clear.reshape(HEIGHT, samples, WIDTH, samples).all(axis=(1, 3))


def oracle(scene, camera):
    return Oracle(scene, camera.view, camera.projection)


def _in_world(item):
    """Positions, normals, and faces counter-clockwise from outside."""
    transform = np.asarray(item.transform, float)
    linear = transform[:3, :3]
    vertices, faces = np.asarray(item.mesh.vertices, float), np.asarray(item.mesh.faces)
    normals = item.mesh.normals
    if normals is None:
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        normals = np.zeros_like(vertices)
        np.add.at(normals, faces, np.cross(b - a, c - a)[:, None])
    normals = reference.normalize(np.asarray(normals, float)) @ np.linalg.inv(linear)
    turned = faces[:, ::-1] if np.linalg.det(linear) < 0 else faces
    return vertices @ linear.T + transform[:3, 3], reference.normalize(normals), turned
