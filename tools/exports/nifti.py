"""Fields as NIfTI images, on the grid of a CT or on a regular one."""
import os

import numpy as np

from pulmo.errors import PulmoError
from reports.fields import Fields

from . import grids, place, probe

SHORT = {"J": "J_mean", "ventilation": "ventilation_since_breath_start", "displacement": "displacement_mm",
         "pressure": "alveolar_pressure_cmH2O"}
SPACING = 2.0           # mm
VOLUME_ERROR = 0.02     # of the voxels' volume against the mesh's, that is told
DISPLACEMENT_VECTOR = 1006  # NIfTI's intent code


def wanted_fields(run, asked, say):
    """Names of the fields to write, as in fields.xdmf."""
    if not asked:
        missing = [short for short, name in SHORT.items() if name not in run.fields.names]
        if missing:
            say(f"this run has no {' and no '.join(missing)} (-airflow off, or no ventilator)")
        return [name for name in SHORT.values() if name in run.fields.names]
    names = [SHORT.get(name, name) for name in asked]
    for name, word in zip(names, asked):
        if name not in run.fields.names:
            raise PulmoError(f"--fields {word}: this run has no such field; it has {', '.join(run.fields.names)}")
    return list(dict.fromkeys(names))


def placement_of(run, given, grid, say):
    """The Placement of the mesh in the image, checked against it."""
    source, option = (given.labels, "--labels") if given.labels else (given.grid, "--grid")
    if not source:
        return place.Placement()
    places, _, volumes = Fields(run.directory).lattice  # points that share out the lung at rest
    lungs = None
    try:
        lungs = place.lungs_of(source, option)
    except PulmoError as error:
        if given.labels:
            raise
        if given.fit:
            raise PulmoError(f"--fit needs the lungs of a label image, but {error}; name one with --labels") from None
        say(f"only the boxes of lung and image were compared, and the lung may lie elsewhere in it, for {error}; --labels LABELS.nii.gz "
            "compares more")
    placement = place.Placement()
    if given.fit:
        placement, on, covered = place.fitted(lungs, places, volumes)
        say(f"--fit: the lung at rest is moved and made {placement.factor:.4f} times as large in every direction, to the volume and the "
            f"middle of the image's lungs; displacements are, too. {100 * on:.0f} % of it then lies on them and covers {100 * covered:.0f} %")
    moved = placement.of(places)
    place.check_box(grid, moved, volumes, say)
    if lungs and not given.fit:
        place.check_lungs(lungs, moved, volumes, say)
    return placement


def grid_of(run, given, moments, say):
    """The Grid that the command line asks for."""
    if given.grid:
        return grids.of_image(given.grid, say)
    points = [run.fields.points] + [run.fields.points + run.fields.values("displacement_mm", s) for s in moments if given.shape == "deformed"]
    return grids.regular(np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0),
                         given.spacing or SPACING)


def save(path, values, grid, description):
    """Writes voxels with the grid's affine, a vector as a displacement."""
    import nibabel

    vector = values.ndim == 4
    image = nibabel.Nifti1Image(values[:, :, :, None, :] if vector else values, grid.written)
    header = image.header
    sform, qform = grid.codes
    image.set_qform(grid.written, qform, strip_shears=True)
    image.set_sform(grid.written if sform or not qform else None, sform)
    header.set_xyzt_units(grid.unit, "sec")
    header["descrip"] = description.encode()[:79]
    if vector:
        header["intent_code"] = DISPLACEMENT_VECTOR
    nibabel.save(image, path)


def values_at(fields, moments, names, factor):
    """(on nodes, on cells) at some times, {name with its time: values}; lengths times a factor."""
    found = {"Node": {}, "Cell": {}}
    for snapshot in moments:
        for name in names:
            values = fields.values(name, snapshot)
            found[fields.centers[name]][f"{name}_{clock(fields, snapshot)}"] = values * factor if name == "displacement_mm" else values
    return found["Node"], found["Cell"]


def clock(fields, snapshot):
    return f"{fields.times[snapshot]:.9g}s"


def check_volume(inside, grid, volume, say):
    """Tells if the voxels in the lung (of a volume, mm^3) do not have its volume."""
    held = np.count_nonzero(inside) * grid.voxel
    if held == 0:
        raise PulmoError("no voxel's centre lies in the lung: the voxels are too large, or the image lies elsewhere")
    if abs(held / volume - 1) > VOLUME_ERROR:
        say(f"WARNING: the voxels in the lung have {held / 1e3:.0f} ml, the lung has {volume / 1e3:.0f} ml: it reaches out of the image, "
            "or the voxels are coarse")


def export(run, given, moments, folder, say):
    """Writes one file for each field and time, and masks of the lung, into a folder; returns their names."""
    if given.fit and not (given.grid or given.labels):
        raise PulmoError("--fit needs a label image: --grid or --labels")
    fields, names, made = run.fields, wanted_fields(run, given.fields, say), []
    grid = grid_of(run, given, moments, say)
    placement = placement_of(run, given, grid, say)
    deformed = given.shape == "deformed"
    for group in [[snapshot] for snapshot in moments] if deformed else [moments]:
        shape = fields.points + (fields.values("displacement_mm", group[0]) if deformed else 0)
        inside, found = probe.sample(grid, placement.of(shape), fields.cells, *values_at(fields, group, names, placement.factor))
        check_volume(inside, grid, (fields.volume(group[0]) if deformed else fields.volumes.sum()) * placement.factor**3, say)
        lung = f"lung_{clock(fields, group[0])}" if deformed else "lung"
        for key, values in [(lung, inside.astype(np.uint8)), *found.items()]:
            if given.outside == "nan" and key != lung:
                values[~inside] = np.nan
            made.append(f"{key}.nii.gz")
            save(os.path.join(folder, made[-1]), values, grid, f"pulmo: {key}, {given.shape} shape, {given.outside} outside the lung")
    return made
