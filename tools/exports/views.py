"""Views of a run of pulmo: ParaView's File > Load State..., or `pvpython views.py PICTURE.png`.

The surface by what came in, three slices by pressure, the lung as it has moved within the lung at rest.
"""
import os
import sys

from paraview import simple as pv

SETTINGS = {}  # tools/export fills this in


def show(source, view, kind, field):
    """Shows a source coloured by a field, with its range over all times."""
    name, title, (low, high) = field
    shown = pv.Show(source, view)
    shown.Representation = "Surface"
    pv.ColorBy(shown, (kind, name))
    colours = pv.GetColorTransferFunction(name)
    colours.ApplyPreset("Viridis (matplotlib)", True)
    colours.RescaleTransferFunction(low, high)
    bar = pv.GetScalarBar(colours, view)
    bar.Title, bar.ComponentTitle = title, ""
    shown.SetScalarBarVisibility(view, True)


def new_view(layout, cell):
    """A view in a cell of the layout."""
    view = pv.CreateRenderView()
    pv.AssignViewToLayout(view=view, layout=layout, hint=cell)
    return view


def look(view, middle):
    """From the front, so that the body's right side is on the left; a little from its right and from above."""
    view.CameraFocalPoint = middle
    view.CameraPosition = [middle[0] + 150, middle[1] + 800, middle[2] + 200]
    view.CameraViewUp = [0, 0, 1]
    pv.ResetCamera(view)


folder = os.path.dirname(os.path.abspath(__file__)) if "__file__" in globals() else ""
path = os.path.join(folder, SETTINGS["from_here"])
if not os.path.exists(path):
    path = SETTINGS["path"]
run = pv.Xdmf3ReaderS(registrationName="run", FileName=[path])
moved = pv.WarpByVector(registrationName="moved", Input=run)
moved.Vectors = ["POINTS", "displacement_mm"]
moved.ScaleFactor = 1.0
layout = pv.CreateLayout(name="pulmo")
layout.SplitHorizontal(0, 0.5)
layout.SplitVertical(2, 0.5)
surface, slices, motion = (new_view(layout, cell) for cell in (1, 5, 6))

animation = pv.GetAnimationScene()
animation.UpdateAnimationUsingDataTimeSteps()
animation.AnimationTime = SETTINGS["time"]

show(moved, surface, "CELLS", SETTINGS["air"])
pv.Show(pv.AnnotateTimeFilter(registrationName="time", Input=run), surface)
for number, normal in enumerate(([0, 1, 0], [1, 0, 0], [0, 0, 1])):
    cut = pv.Slice(registrationName=("coronal", "sagittal", "axial")[number], Input=moved)
    cut.SliceType.Normal = normal
    cut.SliceType.Origin = SETTINGS["planes"][number]
    show(cut, slices, SETTINGS["sliced_kind"], SETTINGS["sliced"])
show(moved, motion, "POINTS", SETTINGS["displacement"])
rest = pv.Show(run, motion)
rest.Representation = "Surface"
rest.Opacity = 0.2
pv.ColorBy(rest, None)
for view in surface, slices, motion:
    look(view, SETTINGS["middle"])
pv.RenderAllViews()
if sys.argv[-1].endswith(".png"):
    pv.SaveScreenshot(sys.argv[-1], layout, ImageResolution=[1600, 1000])
