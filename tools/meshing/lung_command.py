"""The command line of tools/lung_mesh: what may be asked for, defaults, a number of cells, sizes by an earlier run."""
import argparse
import math
import os
import sys
from dataclasses import replace

import numpy as np

from . import mask_command
from .check_command import check, with_whole_volume
from .geometry import tet_volumes
from .labels import EXAMPLE, PARTS
from .lungs import SIDES, Options, make_lungs
from .mesh import MeshError, enough_memory
from .msh import write_mesh
from .picture import picture
from .quality_page import write_page
from .refine import refined
from .report import measures, print_report
from .shape import BRONCHUS_RADIUS, TEMPLATE_VOLUME
from .size_field import read_size_field

DEFAULT_VOLUME = {"right": 1404.0, "left": 1196.0, "both": 2600.0}  # ml
DEFAULT_SIZE = 15.0     # mm, in a lung of the default volume
AIRWAY_SIZE = {"hilum": 8.0, "main": 3.0, "lobar": 4.0}  # mm, likewise
LUNG_VOLUMES = (1e-3, 1e7)  # ml, of any animal
FOLLOWED = 0.85         # of the sizes of a size field: with these gmsh makes about as many cells as the field asks for
TET = 0.118             # volume of a tetrahedron over that of the cube of its edge


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence."""

    def error(self, message):
        self.exit(2, f"lung_mesh: {message}; see --help.\n")


def positive(text):
    """A positive finite number of the command line."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def millilitres(text):
    """A volume of the command line, with or without its unit."""
    return positive(text.removesuffix("ml").strip())


def count(text):
    """A positive whole number of the command line."""
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not a positive whole number")
    return value


def parse(arguments):
    """The command line's options."""
    parser = Parser(prog="lung_mesh", description=(
        "Make a tetrahedral mesh of parametric human lungs, or of those of a segmented CT (axes RAS, mm), with the surfaces airway "
        "and pleura and the volumes right_lung and left_lung, or the lobes."), epilog=(
        "Sizes and volumes are those of the mesh at rest. The default sizes are for the default volumes and "
        "follow the size of the lung. The exit code is 0 only if a mesh that passed its checks was written."))
    ct = parser.add_argument_group("from a segmented CT")
    ct.add_argument("--mask", metavar="LABELS.nii.gz", help=(
        "label image, or a folder with one image for each lung or lobe, named after it; the lobes become volumes of the mesh"))
    ct.add_argument("--labels", metavar="PART=NUMBER,...", help=(
        f"what the labels are, as in {EXAMPLE[9:]}; parts are {', '.join(PARTS)} (default: by the names that come with the file, "
        "else as in TotalSegmentator or lungmask, which is told)"))
    ct.add_argument("--surface", action="append", metavar="PART=FILE", help=(
        "a closed surface (STL, OBJ, PLY, VTP) of a lung, a lobe or the airway in place of --mask, as in --surface right=R.stl "
        "--surface left=L.stl"))
    ct.add_argument("--rim-size", type=positive, metavar="MM", help="element size at the lungs' sharp borders (default: 0.55 of the size)")
    parser.add_argument("--side", choices=SIDES, help="which lung (default: both)")
    parser.add_argument("--volume", type=millilitres, metavar="ML", help=(
        "volume of the whole mesh, ml (default: both 2600, right 1404, left 1196; with --mask the scan's, else scaled in all directions)"))
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--size", type=positive, metavar="MM",
                      help="element size away from the airway and the sharp borders, mm "
                      f"(default: {DEFAULT_SIZE:g}; with --mask {mask_command.SIZE:g})")
    size.add_argument("--cells", type=count, metavar="N",
                      help="aim at N tetrahedra (within 10 %%) instead of a size")
    cut = parser.add_argument_group("finer cells in a mesh that is there")
    cut.add_argument("--refine", metavar="MESH", help=(
        "cut cells of any mesh of tetrahedra through the middle of their longest edge; its names, its volume and its areas stay. Where: --size "
        "(lengths are in the unit of the file), with --near; or --cells; or --size-field of a run on it (--cells: twice as many)"))
    cut.add_argument("--near", metavar="NAME", help="with --refine: the --size holds at this named surface, and grows by 0.4 of the distance from it")
    parser.add_argument("--size-field", metavar="FILE.xdmf", help=(
        "let the sizes follow the errors of a run: errors.xdmf (-error_estimate), or fields.xdmf (-output_fields_error_indicator), on a "
        "mesh of the same lungs; as many tetrahedra as there unless --cells is given"))
    parser.add_argument("--airway", choices=list(AIRWAY_SIZE),
                        help="a hilum patch, a carved main bronchus, or carved lobar bronchi too (default: main)")
    parser.add_argument("--airway-size", type=positive, metavar="MM", help=(
        "element size at the airway, mm (default: " + ", ".join(f"{a} {h:g}" for a, h in AIRWAY_SIZE.items())
        + f"; with --mask {mask_command.AIRWAY_SIZE:g}, less at a small airway)"))
    parser.add_argument("--bronchus-radius", type=positive, metavar="MM", help=(
        "radius of the carved main bronchi, mm in a pair of "
        f"{TEMPLATE_VOLUME:g} ml (default: {BRONCHUS_RADIUS:g}; sets the airway's area)"))
    parser.add_argument("--output", metavar="FILE.msh", default="lung.msh", help="mesh to write (default: lung.msh)")
    parser.add_argument("--format", choices=["4.1", "2.2"], default="4.1", help="version of MSH (default: 4.1)")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--ascii", action="store_true", help="write text (the default, and the shorter file)")
    kind.add_argument("--binary", action="store_true", help="write binary")
    parser.add_argument("--picture", metavar="FILE.png", help="draw the mesh too")
    parser.add_argument("--report", metavar="FILE.html", help="write a page about the mesh: volumes, areas, quality, picture")
    other = parser.add_argument_group("a mesh of another program")
    other.add_argument("--check", nargs="+", metavar="FILE", help=(
        "make nothing, but tell what another mesh holds and whether it would pass (MSH, DOLFIN's HDF5, Exodus, VTU, XDMF, what meshio reads; "
        "several files if cells and groups lie in files of their own)"))
    other.add_argument("--convert", nargs="+", metavar="FILE", help="the same, and write it to --output, even if it would not pass, with its names")
    other.add_argument("--names", metavar="OLD=NEW,...", help="give its groups other names, as in 1=airway,2=pleura")
    return parser.parse_args(arguments)


def check_files(given):
    """Refuses files that cannot be written, before any work."""
    for option, path, ending in (("--output", given.output, ".msh"), ("--picture", given.picture, ".png"),
                               ("--report", given.report, ".html")):
        folder = os.path.dirname(path or "") or "."
        if path and not (path.endswith(ending) and os.path.isdir(folder) and os.access(folder, os.W_OK)):
            raise MeshError(f"{option} {path} must be a {ending} file in a folder that can be written to.")


def check_route(given):
    """Refuses a command line that asks for two things at a time."""
    routes = [option for option in ("mask", "surface", "check", "convert", "refine") if getattr(given, option)]
    if len(routes) > 1:
        raise MeshError(f"--{routes[0]} and --{routes[1]} do not go together; give one.")
    for option, needed in (("names", ("check", "convert")), ("labels", ("mask",)), ("rim_size", ("mask", "surface")),
                           ("near", ("refine",))):
        if getattr(given, option) and not set(routes) & set(needed):
            raise MeshError(f"--{option.replace('_', '-')} has no meaning without --{' or --'.join(needed)}.")


def check_refine(given):
    """Refuses what --refine has no use for."""
    for option in ("side", "volume", "airway", "airway_size", "bronchus_radius"):
        if getattr(given, option):
            raise MeshError(f"--{option.replace('_', '-')} has no meaning with --refine: the mesh keeps its shape and its names.")
    if given.near and (not given.size or given.size_field):
        raise MeshError("--near needs the --size of the cells there, and no --size-field.")
    if not (given.size or given.cells or given.size_field):
        raise MeshError("--refine needs to know where: give --size, --size with --near, --cells or --size-field.")
    if given.size and given.size_field:
        raise MeshError("--size has no meaning with --size-field; give --cells.")
    if os.path.exists(given.output) and os.path.exists(given.refine) and os.path.samefile(given.refine, given.output):
        raise MeshError(f"--output {given.output} is the mesh that --refine reads: give another name.")


def check_request(given, volume, stretch):
    """Refuse at once what cannot be met by far; stretch: of the template. What is left is checked on the lung itself."""
    least, largest = LUNG_VOLUMES
    if not least <= volume <= largest:
        raise MeshError(f"--volume {volume:g} ml is outside {least:g} to {largest:g} ml; a mouse has 0.2 ml, a man 4000 ml.")
    for option, size in (("--size", given.size), ("--airway-size", given.airway_size)):
        if size and not 0.5 * stretch <= size <= 64 * stretch:
            raise MeshError(f"{option} {size:g} mm is no size that a lung of {volume:g} ml can be meshed with; it takes about "
                                f"{3 * stretch:.3g} to {32 * stretch:.3g} mm.")
    fewest, most = (volume * 1e3 / (TET * (size * stretch) ** 3) for size in (64, 2))
    if given.cells and not fewest <= given.cells <= most:
        raise MeshError(f"--cells {given.cells} is outside {fewest:.0f} to {most:.2g}, what a lung of any volume can be meshed with.")
    wanted = given.cells or volume * 1e3 / (TET * (given.size or DEFAULT_SIZE * stretch) ** 3)
    enough_memory(wanted)


def filled_in(given):
    """The Options of a parsed command line, with the defaults that depend on the volume."""
    if given.size_field and (given.size or given.airway_size):
        raise MeshError("--size and --airway-size have no meaning with --size-field; give --cells.")
    side, carved = given.side or "both", given.airway or "main"
    volume = given.volume or DEFAULT_VOLUME[side]
    stretch = (volume / DEFAULT_VOLUME[side]) ** (1 / 3)
    check_request(given, volume, stretch)
    size = given.size or DEFAULT_SIZE * stretch
    airway_size = given.airway_size or min(AIRWAY_SIZE[carved] * stretch, size)
    return Options(side, volume, size, carved, airway_size, given.bronchus_radius or BRONCHUS_RADIUS)


def with_cells(cells, make):
    """The Mesh of about so many tetrahedra; make: Mesh from a factor of the element sizes, which follows the count."""
    factor = 1
    for _ in range(6):
        try:
            mesh = make(factor)
        except MeshError as error:
            raise MeshError(f"--cells {cells} could not be reached: {error}") from error
        if abs(len(mesh.tets) / cells - 1) <= 0.1:
            return mesh
        factor *= (len(mesh.tets) / cells) ** 0.4
    raise MeshError(f"no element size gives about {cells} tetrahedra with this airway; try another --airway-size.")


def resized(options, factor):
    """The Options with all element sizes multiplied."""
    size = options.size * factor
    return replace(options, size=size, airway_size=min(options.airway_size, size))


def adapted(options, path, cells):
    """The Mesh whose sizes follow the run at path; cells: how many tetrahedra, or None for as many as there."""
    field = read_size_field(path)
    volume = np.abs(tet_volumes(field.points, field.tets)).sum() / 1e3
    if abs(volume / options.volume - 1) > 0.01:
        raise MeshError(f"--size-field {path} is of a lung of {volume:.0f} ml, not {options.volume:.0f} ml: give the "
                            "options of the mesh that it ran on.")
    cells = cells or len(field.tets)
    sizes = field.sizes(cells)
    return with_cells(cells, lambda factor: make_lungs(
        replace(options, wanted=(field.points, field.tets, FOLLOWED * factor * sizes))))


def mesh_of(given, options):
    """The Mesh that the command line asks for."""
    if given.size_field:
        return adapted(options, given.size_field, given.cells)
    if given.cells:
        return with_cells(given.cells, lambda factor: make_lungs(resized(options, factor)))
    return make_lungs(options)


def made(given):
    """Makes the mesh and prints its report; returns the Mesh, the checks that it fails, the notes, and volumes it should have."""
    if given.mask or given.surface:
        mask_command.check(given)
        mesh, source = mask_command.make(given, with_cells)
        failures = print_report(mesh, measures(mesh)) + mask_command.compare(mesh, source)
        mask_command.print_times(source)
        return mesh, failures, source.notes, source.mask
    if given.refine:
        check_refine(given)
        mesh, notes = refined(given.refine, given.size, given.cells, given.near, given.size_field)
        for note in notes:
            print("note: " + note)
        return with_whole_volume(mesh), [], notes, None
    mesh = mesh_of(given, filled_in(given))
    return mesh, print_report(mesh, measures(mesh)), [], None


def checked(given):
    """Checks a mesh of another program, and converts it if that is asked for; returns the exit code."""
    files = given.check or given.convert
    mesh, failures, notes = check(files, given.names, bool(given.convert))
    show(given, mesh, os.path.basename(files[0]), failures, notes)
    if given.convert:
        write_mesh(with_whole_volume(mesh), given.output, float(given.format), given.binary, digits=16)
        print(f"wrote {given.output}" + (", although " + "; ".join(failures) if failures else ""))
    elif failures:
        raise MeshError("; ".join(failures) + ".")
    else:
        print("passes all checks")
    return 0


def show(given, mesh, title, failures, notes, mask=None):
    """Writes the picture and the page that were asked for."""
    if given.picture:
        picture(mesh, given.picture)
    if given.report:
        write_page(given.report, mesh, title, failures, notes, mask)


def main(arguments):
    """Run the command line; returns the exit code."""
    given = parse(arguments)
    try:
        check_files(given)
        check_route(given)
        if given.check or given.convert:
            return checked(given)
        mesh, failures, notes, mask = made(given)
        show(given, mesh, os.path.basename(given.output), failures, notes, mask)
        if failures:
            raise MeshError("; ".join(failures) + ", so no mesh was written.")
        write_mesh(mesh, given.output, float(given.format), given.binary, digits=16 if given.refine else 6)
    except MeshError as error:
        print(f"lung_mesh: {error}", file=sys.stderr)
        return 1
    except MemoryError:
        print("lung_mesh: the memory is used up: take fewer tetrahedra.", file=sys.stderr)
        return 1
    print(f"wrote {given.output}")
    return 0
