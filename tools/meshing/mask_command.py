"""The part of tools/lung_mesh that starts from a segmented CT or from closed surfaces: request, mesh, report."""
import time
from dataclasses import dataclass, field

from .geometry import tet_volumes
from .label_image import check_sides, read_labels
from .labels import find_parts, is_pair
from .mask import read_scan
from .mask_lungs import Sizes, make_mask_lungs
from .mask_surface import surfaces
from .mesh import MeshError
from .report import bodies, regions
from .surface_files import read_surfaces
from .surfaces import volume_name

SIZE = 12.0             # mm, cells of a pair of DEFAULT_VOLUME
DEFAULT_VOLUME = 2600   # ml of a pair
AIRWAY_SIZE = 7.0       # mm, likewise
CELL = 0.11             # mean volume of the cells over the cube of their size
RIM_SIZE = 0.55         # of the cells' size elsewhere
VOLUME_ERROR = 0.01     # of the mask's volume, that a mesh is refused for
LOBE_ERROR = 0.03       # that is told for a lobe
NOT_WITH = ["airway", "bronchus_radius", "size_field", "side"]  # options of the parametric lungs


@dataclass
class Made:
    """What was made of a mask: how, out of what, and what was told on the way."""

    source: str
    mask: dict          # {name: ml} of lungs and lobes, mended, at the mesh's volume
    sizes: Sizes = None
    notes: list = field(default_factory=list)
    seconds: dict = field(default_factory=dict)

    def say(self, note):
        """Tells a note and keeps it."""
        self.notes.append(note)
        print("note: " + note, flush=True)


def check(given):
    """Refuses options that have no meaning here."""
    route = "--mask" if given.mask else "--surface"
    for option in NOT_WITH:
        if getattr(given, option):
            raise MeshError(f"--{option.replace('_', '-')} has no meaning with {route}.")


def sizes_for(given, volume, pair):
    """The Sizes of a command line for lungs of a volume (ml)."""
    stretch = (volume / (DEFAULT_VOLUME / (1 if pair else 2))) ** (1 / 3)
    size = given.size or ((volume * 1e3 / (CELL * given.cells)) ** (1 / 3) if given.cells else SIZE * stretch)
    if not 3 * stretch <= size <= 32 * stretch:
        asked = f"--cells {given.cells}, about {size:.2g} mm," if given.cells else f"--size {size:g} mm"
        raise MeshError(f"{asked} is no size that lungs of {volume:.0f} ml can be meshed with; it takes about {3 * stretch:.2g} to "
                        f"{32 * stretch:.2g} mm.")
    airway = given.airway_size or min(AIRWAY_SIZE * stretch, size)
    rim = given.rim_size or RIM_SIZE * size
    for option, value in (("--airway-size", airway), ("--rim-size", rim)):
        if not stretch <= value <= size:
            raise MeshError(f"{option} {value:g} mm is outside {stretch:.2g} mm to the --size, {size:.3g} mm.")
    return Sizes(size, airway, rim, bool(given.airway_size))


def read_input(given, made):
    """The LabelImage that the command line names, its {part: numbers}, and the volume of its lungs, ml."""
    if given.surface:
        image, parts = read_surfaces(given.surface, made.say)
        present = image.labels()
    else:
        image, present = read_labels(given.mask, made.say)
        parts = find_parts(present, image.names, given.labels, made.say)
    check_sides(parts, present, made.source)
    volume = sum(present[n].volume for part, numbers in parts.items() if part != "airway" for n in numbers)
    return image, parts, volume


def tell_mended(scan, volume, say):
    """Tells if islands, holes and gaps made a difference to the volume; volume: of all lung labels, ml."""
    mended = sum(lung.volume for lung in scan.lungs)
    if abs(mended / volume - 1) > VOLUME_ERROR:
        say(f"with islands left out and holes and gaps filled the lungs have {mended:.0f} ml; their labels have {volume:.0f} ml.")
    return mended


def make(given, with_cells):
    """The Mesh that the command line asks for, and its Made. with_cells: as in lung_command."""
    made = Made("--mask " + given.mask if given.mask else "--surface " + " ".join(given.surface), {})
    clock = time.perf_counter()

    def stage(name):
        nonlocal clock
        now = time.perf_counter()
        made.seconds[name] = now - clock
        clock = now

    image, parts, volume = read_input(given, made)
    wanted = given.volume or volume
    made.sizes = sizes_for(given, wanted, is_pair(parts))
    scale = (wanted / volume) ** (1 / 3)
    stage("reading")
    scan = read_scan(image, parts, made.sizes.general / scale, made.say)
    volume = tell_mended(scan, volume, made.say)
    if given.volume:
        scale = (wanted / volume) ** (1 / 3)
        made.say(f"--volume {wanted:.0f} ml: the scan's {volume:.0f} ml times {scale:.4f} in every direction about the middle of the "
                 "lungs. That assumes that the lungs have the same shape at both volumes; real ones do not quite (the diaphragm moves "
                 "more than the ribs), and the mesh no longer lies on the image.")
    for lung in scan.lungs:
        made.mask[volume_name(lung.side)] = lung.volume * scale**3
        made.mask |= {volume_name(name): ml * scale**3 for name, ml in lung.lobe_volumes.items()}
    stage("cleaning")
    in_image = made.sizes.times(1 / scale)
    shapes = surfaces(scan, in_image.general, scale, made.say)
    stage("surfaces")
    if given.cells:
        told = []
        mesh = with_cells(given.cells, lambda factor: make_mask_lungs(scan, shapes, in_image.times(factor), scale, told.append))
        for note in dict.fromkeys(told):
            made.say(note)
    else:
        mesh = make_mask_lungs(scan, shapes, in_image, scale, made.say)
    stage("meshing")
    return mesh, made


def compare(mesh, made):
    """Prints the volumes of the mesh's lungs and lobes against the mask's; returns the failed checks."""
    failures = []
    total = tet_volumes(mesh.points, mesh.tets).sum() / 1e3
    found = {one.name: one.volume for one in bodies(mesh)} | regions(mesh)
    print("volume                 mesh, mask (ml), difference, share of the lungs")
    for name, wanted in made.mask.items():
        off = found.get(name, 0) / wanted - 1
        print(f"{name:<22} {found.get(name, 0):.1f}, {wanted:.1f}, {100 * off:+.2f} %, ".replace("-0.00", "+0.00")
              + f"{100 * found.get(name, 0) / total:.1f} %")
        if name.endswith("_lung") and abs(off) > VOLUME_ERROR:
            failures.append(f"the {name}'s volume is {100 * off:+.1f} % off the mask's")
        elif abs(off) > LOBE_ERROR:
            made.say(f"the {name} is {100 * off:+.1f} % off the mask's: cells of --size {made.sizes.general:.3g} mm are coarse for it.")
    return failures


def print_times(made):
    """Prints how long the stages took."""
    print("seconds                " + ", ".join(f"{name} {seconds:.1f}" for name, seconds in made.seconds.items()))
