"""The other renderers that the benchmarks compare with, each run as its users would run it."""

import functools
from typing import Any, ClassVar

import numpy as np
from renderer import (
    AMBIENT,
    DIFFUSE,
    INTENSITY,
    PARAMETERS,
    SHININESS,
    SPECULAR,
    MissingPeerError,
    Peer,
    Task,
)


class Deodr(Peer):
    """DEODR: edges by overdraw, with their derivative; Gouraud shading without a highlight."""

    name = "DEODR"
    shading = "gouraud"
    samples = True

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        try:
            from deodr.differentiable_renderer import Camera, Scene3D
            from deodr.triangulated_mesh import ColoredTriMesh
        except ImportError as error:
            raise MissingPeerError(f"install diffrast[peers] for DEODR: {error}") from error

        class PoseCamera(Camera):
            """Keeps the derivative by the points in its own system.

            DEODR 0.2.3 multiplies it by the transpose of the rotation that leads to the world.
            """

            def project_points_backward(self, points_b: Any, store_backward: Any) -> Any:
                _, depths, projected = store_backward["project_points"]
                plane_b = points_b @ self.intrinsic[:2, :2] / depths[:, None]
                depths_b = -(plane_b * projected).sum(axis=1)
                self.eye_b = np.column_stack([plane_b, depths_b])
                return self.eye_b @ self.extrinsic[:, :3]

        vertices = np.asarray(task.mesh.vertices, np.float64)
        mesh = ColoredTriMesh(
            np.asarray(task.mesh.faces), vertices, colors=np.tile(DIFFUSE, (len(vertices), 1))
        )
        flip = np.diag([1.0, -1.0, -1.0])  # x right, y down, z forward
        half = task.size / 2
        intrinsic = np.array(
            [[half * task.focal, 0, half], [0, half * task.focal, half], [0, 0, 1]]
        )
        extrinsic = flip @ np.asarray(task.camera.view, np.float64)[:3]
        self.flip = flip
        self.camera = PoseCamera(extrinsic, intrinsic, task.size, task.size)
        self.scene = Scene3D(sigma=1, integer_pixel_centers=False)
        self.scene.set_mesh(mesh)
        self.scene.set_light(INTENSITY * task.direction, AMBIENT)
        self.scene.set_background_color(np.zeros(3))
        self.vertices = vertices

    def image(self) -> np.ndarray:
        self.scene.mesh.set_vertices(self.vertices)
        return self.scene.render(self.camera)  # its derivative needs back faces culled

    def gradient(self, target: np.ndarray) -> np.ndarray:
        image = self.image()
        self.scene.clear_gradients()
        self.scene.render_backward(2 * (image - target))
        eye_b = self.camera.eye_b
        eye = self.camera.world_to_camera(self.vertices)
        turned, moved = np.cross(eye, eye_b).sum(axis=0), eye_b.sum(axis=0)
        # The direction's length is the intensity there: only turning it is a light of ours.
        direction_b = INTENSITY * self.scene.light_directional_b
        direction_b = direction_b - (direction_b @ self.task.direction) * self.task.direction
        shifted = self.scene.mesh._vertices_b.sum(axis=0)
        return np.concatenate([self.flip @ turned, self.flip @ moved, direction_b, shifted])


class Mitsuba(Peer):
    """Mitsuba 3 on the CPU: rays on a regular grid, derivative of the interior only.

    The object's translation is that of the rays, so that nothing is built again; what can be is
    traced once (`freeze`).
    """

    name = "Mitsuba"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        try:
            import drjit
            import mitsuba

            mitsuba.set_variant("llvm_ad_rgb")
        except ImportError as error:
            raise MissingPeerError(
                f"install diffrast[peers] and an LLVM library for Mitsuba: {error}"
            ) from error
        self.drjit, self.mitsuba = drjit, mitsuba
        faces = np.asarray(task.mesh.faces)
        mesh = mitsuba.Mesh("mesh", len(task.mesh.vertices), len(faces), has_vertex_normals=True)
        content = mitsuba.traverse(mesh)
        content["vertex_positions"] = np.asarray(task.mesh.vertices, np.float32).ravel()
        content["vertex_normals"] = np.asarray(task.mesh.normals, np.float32).ravel()
        content["faces"] = faces.astype(np.uint32).ravel()
        content.update()
        scene = mitsuba.load_dict({"type": "scene", "mesh": mesh})
        fine = task.size * self.side
        centres = ((2 * np.arange(fine) + 1) / fine - 1).reshape(task.size, self.side)
        # By row and column, and within them by row and column of the pixel's samples.
        x = np.broadcast_to(centres[:, None, :], (task.size, task.size, self.side, self.side))
        y = np.broadcast_to(-centres[:, None, :, None], x.shape)
        view = np.asarray(task.camera.view, np.float64)
        self.inverse, self.offset = view[:3, :3].T.tolist(), view[:3, 3].tolist()
        columns = [mitsuba.Float(np.float32(each.ravel() / task.focal)) for each in (x, y)]
        parameters = [mitsuba.Float([0.0]) for _ in range(PARAMETERS)]
        self.inputs = scene, parameters, mitsuba.Vector3f(*columns, -1)
        self.frozen_image = drjit.freeze(self._draw)
        self.frozen_gradient = drjit.freeze(self._differentiate)

    def _draw(self, scene: Any, parameters: list[Any], ray: Any) -> Any:
        drjit, mitsuba = self.drjit, self.mitsuba
        turn, move, light, shift = (
            mitsuba.Vector3f(*parameters[i : i + 3]) for i in range(0, PARAMETERS, 3)
        )

        def unturned(vector: Any) -> Any:
            """The inverse rotation, to the second order."""
            once = drjit.cross(vector, turn)
            return vector + once + 0.5 * drjit.cross(once, turn)

        inverse = mitsuba.Matrix3f(self.inverse)
        origin = inverse @ (unturned(-move) - mitsuba.Vector3f(self.offset)) - shift
        direction = drjit.normalize(inverse @ unturned(ray))
        hit = scene.ray_intersect(mitsuba.Ray3f(origin, direction))
        normal, to_light = hit.sh_frame.n, -drjit.normalize(light + self.task.direction.tolist())
        cosine = drjit.dot(normal, to_light)
        diffuse = AMBIENT + INTENSITY * drjit.select(cosine > 0, cosine, 0)
        along = drjit.dot(to_light, direction) - 2 * cosine * drjit.dot(normal, direction)
        shiny = (along > 0) & (cosine > 0)
        highlight = SPECULAR * drjit.select(
            shiny, drjit.power(drjit.select(shiny, along, 1), SHININESS), 0
        )
        color = mitsuba.Color3f(*DIFFUSE) * diffuse + highlight
        color = drjit.select(hit.is_valid(), color, 0)
        if self.side == 1:
            return color
        return mitsuba.Color3f(*(drjit.block_sum(c, self.side**2) for c in color)) / self.side**2

    def _differentiate(self, scene: Any, parameters: list[Any], ray: Any, target: Any) -> list[Any]:
        # One value a ray: sums over rays within the derivative would each trace all of them again.
        drjit = self.drjit
        wide = [
            parameter + drjit.zeros(type(parameter), (self.task.size * self.side) ** 2)
            for parameter in parameters
        ]
        drjit.enable_grad(wide)
        difference = self._draw(scene, wide, ray) - target
        drjit.backward(drjit.squared_norm(difference))
        gradients = [drjit.grad(parameter) for parameter in wide]
        drjit.eval(gradients)
        return [drjit.sum(gradient) for gradient in gradients]

    def image(self) -> np.ndarray:
        color = self.drjit.ravel(self.frozen_image(*self.inputs))
        return np.array(color).reshape(self.task.size, self.task.size, 3)

    def gradient(self, target: np.ndarray) -> np.ndarray:
        columns = self.mitsuba.Color3f(*(np.ravel(target[..., c]) for c in range(3)))
        gradient = self.frozen_gradient(*self.inputs, columns)
        self.drjit.eval(gradient)
        return np.array([float(value[0]) for value in gradient])


VERTEX_SHADER = """
#version 330
uniform mat4 clip_from_world;
in vec3 position, normal;
out vec3 at, up;
void main() { at = position; up = normal; gl_Position = clip_from_world * vec4(position, 1); }
"""
FRAGMENT_SHADER = """
#version 330
uniform vec3 to_light, eye, reflectance;
uniform float ambient, intensity, specular, shininess;
in vec3 at, up;
out vec4 color;
void main() {
    vec3 n = normalize(up), v = normalize(eye - at);
    float cosine = dot(n, to_light);
    float along = 2 * cosine * dot(n, v) - dot(to_light, v);
    float shine = cosine > 0 && along > 0 ? specular * pow(along, shininess) : 0;
    color = vec4(reflectance * (ambient + intensity * max(cosine, 0)) + shine, 1);
}
"""


class Llvmpipe(Peer):
    """Mesa's software OpenGL, 8 bits a channel; draws only."""

    name = "llvmpipe"
    differentiable = False
    multisamples: ClassVar[int] = 0

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        try:
            import moderngl

            context = _context(moderngl)
        except Exception as error:
            raise MissingPeerError(
                "llvmpipe needs moderngl (install diffrast[peers]) and Mesa's libEGL, libGL and"
                f" software driver: {error}"
            ) from error
        self.context = context
        program = context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
        view = np.asarray(task.camera.view, np.float64)
        values: dict[str, Any] = {
            "clip_from_world": (np.asarray(task.camera.projection, np.float64) @ view).T,
            "to_light": -task.direction,
            "eye": -view[:3, :3].T @ view[:3, 3],
            "reflectance": np.array(DIFFUSE),
            "ambient": AMBIENT,
            "intensity": INTENSITY,
            "specular": SPECULAR,
            "shininess": SHININESS,
        }
        for name, value in values.items():
            program[name] = tuple(np.ravel(value)) if np.ndim(value) else value
        corners = np.hstack([task.mesh.vertices, task.mesh.normals]).astype(np.float32)
        self.vertex_array = context.vertex_array(
            program,
            [(context.buffer(corners.tobytes()), "3f 3f", "position", "normal")],
            context.buffer(np.asarray(task.mesh.faces, np.int32).tobytes()),
        )
        size = (task.size, task.size)
        self.target = context.simple_framebuffer(size)
        self.drawn = self.target
        if self.multisamples:
            self.drawn = context.simple_framebuffer(size, samples=self.multisamples)

    def image(self) -> np.ndarray:
        context = self.context
        context.enable_only(context.DEPTH_TEST | (context.CULL_FACE if self.task.closed else 0))
        self.drawn.use()
        self.drawn.clear()
        self.vertex_array.render()
        if self.drawn is not self.target:
            context.copy_framebuffer(self.target, self.drawn)
        pixels = np.frombuffer(self.target.read(components=4), np.uint8)
        size = self.task.size
        return pixels.reshape(size, size, 4)[::-1, :, :3]


class Llvmpipe4(Llvmpipe):
    """The same with four samples a pixel."""

    name = "llvmpipe 4x"
    samples = True
    multisamples = 4


@functools.cache
def _context(moderngl: Any) -> Any:
    """One context for all: a second one would have to be made current before each picture."""
    return moderngl.create_context(standalone=True, backend="egl")


PEERS: tuple[type[Peer], ...] = (Deodr, Mitsuba, Llvmpipe, Llvmpipe4)
