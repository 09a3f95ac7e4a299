"""What `planning` predicts against what quadrature measures, and what a plan saves."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import Status, harmonics, models, planning, reference, shading
from shisd.planning._bands import known_light, known_material
from shisd.planning._choice import _choose, _first
from shisd.planning._paths import PATHS, Polygon, Table
from shisd.planning._prediction import judge
from tests.bench.lobes import load_map
from tests.bench.timing import interleaved
from tests.models.materials import GOLD_PAINT

HEIGHT = 64  # rows of the maps: quadrature over every texel stays affordable
LAMP = np.array([[-0.5, -0.5, 1.5], [-0.5, 0.5, 1.5], [0.5, 0.5, 1.5], [0.5, -0.5, 1.5]], np.float32)
RADIUS = 0.5  # of the ball on which positions are


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def materials():
    return {
        "clay": models.Lambertian(np.array([0.75, 0.6, 0.5])),
        "red plastic": models.CookTorrance(0.5, 0.0, np.array([0.6, 0.06, 0.05])),
        "copper": models.CookTorrance(0.45, 1.0, np.array([0.95, 0.64, 0.54])),
        "gold paint": models.SgdMicrofacet(**{name: np.asarray(value) for name, value in GOLD_PAINT.items()}),
    }


def small_map(name):
    texels = load_map(name).texels
    step = texels.shape[0] // HEIGHT
    return models.Environment(texels.reshape(HEIGHT, step, 2 * HEIGHT, step, 3).mean(axis=(1, 3)))


def sky():
    gradient = lambda d: (1 + d[:, 2:]) * jnp.asarray([[0.5, 0.7, 1.0]], d.dtype)
    return models.Environment.from_function(gradient, HEIGHT)


def pixels(count, seed=0):
    """Positions, normals, views: mirror directions and elevations of views spread evenly, the rest at random.

    A few bright texels seen in grazing reflection make most of the mean square, so a random choice would need many
    more pixels.
    """
    rng = np.random.default_rng(seed)
    i = np.arange(count)
    z, phi = 1 - (2 * i + 1) / count, np.pi * (np.sqrt(5) - 1) * i
    mirror = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    sine = np.sqrt((rng.permutation(count) + 0.5) / count)[:, None]
    side = unit(np.cross(mirror, unit(rng.normal(size=(count, 3)))))
    normals = np.sqrt(1 - sine**2) * mirror + sine * side
    views = 2 * np.sqrt(1 - sine**2) * normals - mirror
    return tuple(np.asarray(a, np.float32) for a in (RADIUS * normals, normals, views))


def relative(got, truth):
    return float(np.sqrt(np.mean((np.asarray(got) - truth) ** 2) / np.mean(np.square(truth))))


def truth_of(brdf, light, where):
    if isinstance(light, models.Environment):
        return np.asarray(reference.shade_environment_quadrature(brdf, light, *where[1:]))
    if isinstance(light, models.PortalLight):
        emission = lambda w: harmonics.evaluate(light.coefficients, w[:, None])
    else:
        emission = light.emission
    return np.asarray(reference.shade_polygon_quadrature(brdf, light.points, emission, *where, nodes=24))


def general(brdf, light, degree, views=64):
    """A function of pixels: one light by the path that always works."""
    if isinstance(light, models.PolygonLight):
        material = shading.tabulate_brdf(brdf, degree, elevations=views, domain="upper", throw=False)
        return lambda p, n, v: shading.shade(material, light, shading.Surface(n, v, p))
    material = shading.tabulate_brdf(brdf, degree, elevations=views, throw=False)
    distant = light.light(degree) if isinstance(light, models.Environment) else light
    return lambda p, n, v: shading.shade(material, distant, shading.Surface(n, v))


def bench_prediction(degrees=(4, 8, 16), count=1024, names=("interior", "studio")):
    """Relative RMS error of truncation at a degree, of the worst colour: predicted from band energies, and measured.

    Maps of 64 x 128 and a square lamp, pixels turned in all ways. Measured against quadrature of the material itself;
    bound: the RMS that no choice of rotations exceeds.
    """
    rows = []
    lights = {name: small_map(name) for name in names} | {"lamp": models.PolygonLight(LAMP, np.float32([3, 2, 1]))}
    where = pixels(count)
    reference_degree = 60
    seen = {name: known_light(name, x, jnp.asarray(where[0][::80]), reference_degree) for name, x in lights.items()}
    for material, brdf in materials().items():
        known = known_material(brdf, reference_degree, 64)
        for name, light in lights.items():
            truth = truth_of(brdf, light, where)
            path = Polygon if name == "lamp" else Table
            for degree in degrees:
                judged = judge(path, known, seen[name], degree)
                measured = worst_colour(general(brdf, light, degree)(*where), truth)
                rows.append({
                    "material": material,
                    "light": name,
                    "degree": degree,
                    "predicted %": 100 * judged.error,
                    "measured %": 100 * measured,
                    "predicted / measured": judged.error / measured,
                    "bound %": 100 * judged.bound,
                })  # fmt: skip
                print(rows[-1], flush=True)
    return rows


def eight_materials():
    more = {
        "GGX 0.5": models.Ggx(0.5, 0.04), "GGX 0.3": models.Ggx(0.3, 0.5), "GGX 0.2": models.Ggx(0.2),
        "Phong 40": models.Phong(np.array([0.4, 0.5, 0.3]), 40.0, 0.2),
    }  # fmt: skip
    return materials() | more


def eight_lights():
    """Three photographed maps of other colours or a sun, a gradient, and lamps: overhead, small, upright, a window."""
    sun = models.Environment.from_function(sun_and_sky, HEIGHT)
    low = LAMP @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)  # across the horizon of most points
    room = small_map("interior").light(4).coefficients
    return {
        "interior": small_map("interior"),
        "studio": small_map("studio"),
        "sun": sun,
        "sky": sky(),
        "lamp": models.PolygonLight(LAMP, np.float32([3, 2, 1])),
        "small lamp": models.PolygonLight(LAMP * np.float32([0.3, 0.3, 0.6]), np.float32(30)),
        "upright": models.PolygonLight(low, np.float32([1, 2, 3])),
        "window": models.PortalLight(LAMP[:3], room),
    }


def sun_and_sky(w):
    """A sun as wide as a few texels, 50 times as bright as a sky that darkens downwards."""
    toward = jnp.asarray(unit(np.array([0.4, -0.5, 0.77])), w.dtype)
    disc = 50 * jnp.exp(300 * (w @ toward - 1))
    return disc[:, None] * jnp.asarray([[1.0, 0.9, 0.8]], w.dtype) + (1 + w[:, 2:]) * jnp.asarray(
        [[0.3, 0.5, 0.8]], w.dtype
    )


def bench_tolerances(tolerances=(0.1, 0.03, 0.01), max_degree=30, timed=(0.1, 0.01)):
    """Whether plans keep what they promise: eight materials, eight lights, three tolerances, each pair by itself.

    `kept`: of those that are met by prediction. Predicted over measured: the middle and the ends of the middle 95 %, of
    errors above a thirtieth of the tolerance, which the reference resolves. Of the worst colour; pixels are turned in
    all ways, 1024 for distant lights and 8192 for local ones; measured against quadrature of the material itself.
    `fastest`: of pairs for which several paths meet the tolerance by prediction, how often the one chosen took at most
    1.3 times as long as the fastest of them, for 16384 pixels; and the most that it took.
    """
    many = pixels(8192)
    points, normals = (jnp.asarray(a[::32]) for a in many[:2])
    crowd = shading.Surface(*(jnp.asarray(pixels(16384)[i]) for i in (1, 2, 0)))
    reference_degree = max(32, 2 * max_degree)
    seen = {n: known_light(n, light, points, reference_degree, normals) for n, light in eight_lights().items()}
    found = []
    for material, brdf in eight_materials().items():
        known = known_material(brdf, reference_degree, 64)
        slices = shading.tabulate_brdf(brdf, max_degree, throw=False)
        for name, light in eight_lights().items():
            where = pixels(1024) if isinstance(light, models.Environment) else many
            truth, seconds = truth_of(brdf, light, where), {}
            for tolerance in tolerances:
                ways = candidates(known, seen[name], tolerance / 1.5, max_degree)
                chosen = _choose(judge, known, seen[name], tolerance / 1.5, max_degree)
                make = functools.partial(made, known, slices, seen[name])
                measured = worst_colour(make(chosen).shade(shading.Surface(*where[1:], where[0])), truth)
                slower = None
                if tolerance in timed and len(ways) > 1:
                    new = {key: make(way) for key, way in ways.items() if key not in seconds}
                    calls = {key: functools.partial(shade_by, way) for key, way in new.items()}
                    if calls:
                        seconds |= {key: t.best for key, t in interleaved(calls, crowd, seconds=1.0).items()}
                    slower = seconds[chosen.path.name, chosen.degree] / min(seconds[key] for key in ways)
                found.append((tolerance, chosen.path.name, chosen.error, measured, slower))
                print(material, name, *found[-1], {key: f"{1e9 * seconds[key] / 16384:.0f} ({way.cost:.0f})" for
                      key, way in ways.items() if key in seconds}, flush=True)  # fmt: skip
        jax.clear_caches()  # what is compiled for hundreds of plans is more than a process may map
    return [kept(tolerance, [x[1:] for x in found if x[0] == tolerance]) for tolerance in tolerances]


@eqx.filter_jit
def shade_by(path, surface):
    return path.shade(surface)


def made(material, slices, light, choice):
    return choice.path.make(material, slices, [light], choice.degree)


def candidates(material, light, target, max_degree):
    """The cheapest of each path that meets the target, by its name and degree."""
    good = {}
    for path in PATHS:
        if path.takes is light.kind:
            met = [c for c in _first(judge, path, material, light, target, max_degree, np.inf) if c.error <= target]
            good |= {(c.path.name, c.degree): c for c in sorted(met, key=lambda c: c.cost)[:1]}
    return good


def kept(tolerance, choices):
    """A row of `bench_tolerances` from names of paths, predicted and measured errors, and time over the least."""
    met = [x for x in choices if x[1] <= tolerance / 1.5]
    ratios = np.array([predicted / measured for _, predicted, measured, _ in met if measured > tolerance / 30])
    low, middle, high = np.quantile(ratios, [0.025, 0.5, 0.975])
    names = [name for name, *_ in met]
    times = np.array([slower for *_, slower in met if slower is not None])
    return {
        "tolerance %": 100 * tolerance,
        "pairs": len(choices),
        "met": len(met),
        "kept": sum(measured <= tolerance for _, _, measured, _ in met),
        "worst / tolerance": max(measured for _, _, measured, _ in met) / tolerance,
        "predicted / measured": f"{middle:.2f} ({low:.2f} to {high:.2f})",
        "within 0.5 to 2": float(np.mean((ratios >= 0.5) & (ratios <= 2))),
        "fastest": f"{np.mean(times <= 1.3):.2f} of {len(times)}, {np.max(times):.1f}" if len(times) else "",
        "paths": ", ".join(f"{names.count(name)} {name}" for name in dict.fromkeys(names)),
    }  # fmt: skip


def worst_colour(got, truth):
    square = lambda x: np.mean(np.square(np.asarray(x, float).reshape(len(truth), -1)), axis=0)
    return float(np.max(np.sqrt(square(got - truth) / square(truth))))


def bench_saving(tolerances=(0.1, 0.05), count=16384, judged=512):
    """What a plan saves in a mixed scene against the general path at one safe degree, the largest of the plan.

    Clay, red plastic, copper and gold paint under the interior, a sky gradient and a lamp; 16384 pixels of each. Added
    up: the same with both distant lights as one. Tolerances and errors are of all colours together; errors: the worst
    of the materials under all lights, against quadrature.
    """
    rows = []
    lamp = models.PolygonLight(LAMP, np.float32([3, 2, 1]))
    lights = {"interior": small_map("interior"), "sky": sky(), "lamp": lamp}
    where, few = pixels(count), pixels(judged, seed=1)
    for tolerance in tolerances:
        scene = planning.Scene(materials(), lights, where[0][:: count // 12])
        made = planning.plan(scene, tolerance, pooled=True, throw=False)
        degree = max(entry.degree for entry in made.entries)
        both = models.DistantLight(sum(light.coefficients(degree) for light in list(lights.values())[:2]))
        separate, added = {}, {}
        for name, brdf in materials().items():
            calls = [general(brdf, light, degree) for light in lights.values()]
            separate[name] = lambda *w, calls=calls: sum(call(*w) for call in calls)
            calls = [general(brdf, both, degree), calls[2]]
            added[name] = lambda *w, calls=calls: sum(call(*w) for call in calls)
        planned = {
            name: lambda p, n, v, made=made, name=name: made.shade(name, shading.Surface(n, v, p)) for name in separate
        }
        ways = {"plan": planned, "one degree": separate, "one degree, added up": added}
        every = {way: lambda *w, each=each: [shade(*w) for shade in each.values()] for way, each in ways.items()}
        times = interleaved(every, *(jnp.asarray(a) for a in where), seconds=5.0)
        truths = {n: sum(truth_of(b, light, few) for light in lights.values()) for n, b in materials().items()}
        print(made, flush=True)
        for way, each in ways.items():
            rows.append({
                "tolerance %": 100 * tolerance,
                "way": way,
                "degrees": " ".join(str(e.degree) for e in made.entries) if way == "plan" else str(degree),
                "met": bool(made.status == Status.ok),
                "us per pixel, all materials": times[way].median / count * 1e6,
                "time / plan": times[way].median / times["plan"].median,
                "worst error %": 100 * max(relative(each[name](*few), truth) for name, truth in truths.items()),
            })  # fmt: skip
            print(rows[-1], flush=True)
    return rows
