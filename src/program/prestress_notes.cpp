// A lung under pressure, part by part: how far the law is inflated, and what is left of its volume.
#include "pulmo/program/prestress_notes.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/physics/law_range.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>

namespace pulmo {

namespace {

constexpr PetscReal nearly_neutral = 0.25;                    ///< of dp/dJ at rest
constexpr int path = 50;                                      ///< states that are looked at on the way to J0
constexpr PetscReal least_stretch = 0.7, largest_stretch = 4; ///< J0 of a lung
constexpr PetscReal rounding = 1e-9;

using Constants = std::vector<PetscScalar>;

/// A piece of tissue that inflates freely from rest to the transpulmonary pressure.
struct Piece {
  LawRange::State end{};            ///< where inflation ends
  std::optional<PetscReal> J0;      ///< nothing: it does not take that pressure
  PetscReal at_rest = 0, least = 0; ///< dp/dJ, and its least on the way, kPa

  /// @p stiffness: look at that, too.
  Piece(const TissueLaw &law, PetscReal pressure, const Constants &constants, bool stiffness)
      : J0(inflated_J(law, pressure, constants.data(), &end))
  {
    if (!J0 || !stiffness) return;
    least = at_rest = inflation_stiffness(law, 1, constants.data());
    for (int i = 1; i <= path; ++i)
      least = std::min(least, inflation_stiffness(law, std::pow(*J0, (PetscReal)i / path), constants.data()));
  }
};

/// Calls @p visit with the constants of each cell of this rank, free of stress in the shape of the mesh, and the piece
/// that it is.
PetscErrorCode visit_cells(const Scene &scene, const Composition &composition, bool stiffness,
                           const std::function<PetscErrorCode(PetscInt cell, const Constants &, const Piece &)> &visit)
{
  const PetscReal pressure = scene.facts().prestress->pressure;
  const auto varying = composition.varying();
  Constants constants = composition.constants(Step());
  std::map<Constants, Piece> pieces; // by the parameters of the law
  PetscInt begin, end, count;

  PetscFunctionBeginUser;
  (void)scene.tissue().law().parameters(&count);
  const PetscInt first = constants::offset_of(constants::tag("tissue"), constants.data());
  PetscCall(DMPlexGetHeightStratum(composition.mesh().dm(), 0, &begin, &end));
  for (PetscInt c = 0; c < end - begin; ++c) {
    if (varying) varying->patch(c, "", constants);
    StressFree::forget(constants);
    const Constants own(constants.begin() + first, constants.begin() + first + count);
    auto found = pieces.find(own);
    if (found == pieces.end())
      found = pieces.emplace(own, Piece(scene.tissue().law(), pressure, constants, stiffness)).first;
    PetscCall(visit(c, constants, found->second));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The worst of all cells, and what is told of it.
struct Worst {
  struct {
    double value = -PETSC_MAX_REAL;
    int rank = 0;
  } most;                  ///< how bad it is
  PetscReal told[4] = {0}; ///< numbers of the worst
  PetscReal volume = 0;    ///< of all that is bad, mm^3

  void look(PetscReal value, bool bad, PetscReal of_cell, std::initializer_list<PetscReal> numbers)
  {
    if (bad) volume += of_cell;
    if (!bad || !(value > most.value)) return;
    most.value = value;
    std::copy(numbers.begin(), numbers.end(), told);
  }
  /// Collective.
  PetscErrorCode share(MPI_Comm comm)
  {
    PetscFunctionBeginUser;
    PetscCallMPI(MPI_Comm_rank(comm, &most.rank));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &most, 1, MPI_DOUBLE_INT, MPI_MAXLOC, comm));
    PetscCallMPI(MPI_Bcast(told, 4, MPIU_REAL, most.rank, comm));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &volume, 1, MPIU_REAL, MPI_SUM, comm));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  bool found() const { return volume > 0; }
  /// Where it is, if not everywhere.
  std::string where(PetscReal whole) const
  {
    char text[60] = "";
    if (volume < (1 - rounding) * whole)
      std::snprintf(text, sizeof(text), " (in %.3g ml of it)", (double)(volume / units::mm3_per_ml));
    return text;
  }
};

/// Says that the law takes the porosity for that of the unloaded tissue, and which that would be: it has the solid of
/// the mesh, 1 - Phi = (1 - Phi0) J0, and J0 is that of a law with Phi.
PetscErrorCode note_porosity_of_law(MPI_Comm comm, const Scene &scene, const Composition &composition)
{
  constexpr int halvings = 30;
  constexpr PetscReal same = 0.01; // of the porosity
  const TissueLaw &law = scene.tissue().law();
  const PetscScalar *target = scene.tissue().porosity_of_law();
  const char *owner = nullptr;

  PetscFunctionBeginUser;
  if (!target) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscInt offset = composition.constant_at(target, &owner);
  PetscCheck(offset >= 0, comm, PETSC_ERR_ARG_WRONG, "the porosity of a law is in no block that was handed over");
  Constants constants = composition.constants(Step());
  StressFree::forget(constants);
  const PetscReal solid = 1 - *target;
  PetscReal low = LawRange::least_J, high = 1 / solid; // what law grows stiffer with its solid: J0 falls
  for (int n = 0; n < halvings; ++n) {
    const PetscReal J = (low + high) / 2;
    constants[static_cast<std::size_t>(offset)] = 1 - solid * J;
    (inflated_J(law, scene.facts().prestress->pressure, constants.data()).value_or(PETSC_MAX_REAL) > J ? low : high) =
        J;
  }
  const PetscReal unloaded = 1 - solid * low;
  if (composition.varying())
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: -tissue %s is made from -tissue_porosity as if that were the porosity of the "
                          "unloaded tissue; with -prestress it is that of the mesh, and the unloaded tissue has less "
                          "(docs/effects/prestress.md says which parameters are its own)\n",
                          law.name()));
  else if (std::abs(unloaded - *target) > same)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: -tissue %s is made from -tissue_porosity %.3g as if that were the porosity of "
                          "the unloaded tissue; with -prestress it is that of the mesh, and unloaded tissue of as much "
                          "solid has %.3g, with %.3g of the volume (docs/effects/prestress.md says which parameters "
                          "are its own)\n",
                          law.name(), (double)*target, (double)unloaded, (double)(1 / low)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode warn_of_prestress(MPI_Comm comm, const Scene &scene, const Model &model)
{
  if (!scene.facts().prestress) return PETSC_SUCCESS;
  const Composition &composition = model.composition();
  const PrestressFacts &prestress = *scene.facts().prestress;
  const Unloading *unloading = prestress.unloading.get();
  const char *law = scene.tissue().law().name();
  const PetscReal whole = scene.mesh().volume(), pressure = prestress.pressure / units::kPa_per_cmH2O;
  const PetscInt porosity = constants::offset_of(constants::tag(Porosity::owner), composition.constants(Step()).data());
  const DM dm = composition.mesh().dm();
  Worst stretch, neutral, solid;
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  const std::size_t points =
      unloading && end > begin
          ? unloading->points->size() / static_cast<std::size_t>(end - begin) / Unloading::AtPoint::count
          : 0;
  PetscCall(visit_cells(scene, composition, true, [&](PetscInt c, const Constants &constants, const Piece &piece) {
    PetscReal volume, J = piece.J0.value_or(1);

    PetscFunctionBeginUser;
    PetscCall(DMPlexComputeCellGeometryFVM(dm, begin + c, &volume, nullptr, nullptr));
    if (piece.J0) {
      stretch.look(std::abs(std::log(J)), J < least_stretch || J > largest_stretch, volume, {1 / J});
      neutral.look(-piece.least / piece.at_rest, piece.least < nearly_neutral * piece.at_rest, volume,
                   {piece.least, piece.at_rest, 1 / J});
    }
    const PetscScalar *at =
        unloading ? unloading->points->data() + static_cast<std::size_t>(c) * points * Unloading::AtPoint::count
                  : nullptr;
    for (std::size_t q = 0; q < points; ++q) {
      const PetscReal of_point = determinant(at + q * Unloading::AtPoint::count + Unloading::AtPoint::F0);
      J = q == 0 ? of_point : std::max(J, of_point);
    }
    const PetscReal tissue =
        1 - (porosity > 0 ? constants[static_cast<std::size_t>(porosity)] : scene.tissue().porosity().reference);
    solid.look(tissue * J, tissue * J > 1 + rounding, volume, {1 / J, tissue});
    PetscFunctionReturn(PETSC_SUCCESS);
  }));
  PetscCall(stretch.share(comm));
  PetscCall(neutral.share(comm));
  PetscCall(solid.share(comm));
  if (stretch.found())
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: -prestress_pressure %g cmH2O with -tissue %s: the unloaded lung%s has %.3g "
                          "of the volume of the mesh, which is no lung's; give the transpulmonary pressure of the "
                          "image, some 5 cmH2O\n",
                          (double)pressure, law, stretch.where(whole).c_str(), (double)stretch.told[0]));
  if (neutral.found())
    PetscCall(PetscPrintf(
        comm,
        "pulmo: warning: -tissue %s%s is nearly neutral at -prestress_pressure %g cmH2O: dp/dJ is "
        "%.3g cmH2O on the way there at its least, %.3g at rest, and the unloaded lung has %.3g of the volume; small "
        "changes of pressure or parameters move these numbers far\n",
        law, neutral.where(whole).c_str(), (double)pressure, (double)(neutral.told[0] / units::kPa_per_cmH2O),
        (double)(neutral.told[1] / units::kPa_per_cmH2O), (double)neutral.told[2]));
  if (solid.found())
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: -prestress_pressure %g cmH2O with -tissue %s: the unloaded lung%s has %.3g "
                          "of the volume of the mesh, less than its own solid, 1 - Phi0 = %.3g (-tissue_porosity): "
                          "there would be less than no air in it. What to try: the porosity of the image, less "
                          "pressure, stiffer tissue\n",
                          (double)pressure, law, solid.where(whole).c_str(), (double)solid.told[0],
                          (double)solid.told[1]));
  PetscCall(note_porosity_of_law(comm, scene, composition));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode find_weak_part(const Scene &scene, const Composition &composition, std::string &text)
{
  const DM dm = composition.mesh().dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  Worst weak;
  PetscInt begin;
  char told[300];

  PetscFunctionBeginUser;
  text.clear();
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, nullptr));
  PetscCall(visit_cells(scene, composition, false, [&](PetscInt c, const Constants &, const Piece &piece) {
    PetscReal volume;

    PetscFunctionBeginUser;
    PetscCall(DMPlexComputeCellGeometryFVM(dm, begin + c, &volume, nullptr, nullptr));
    weak.look(-std::abs(piece.end.pressure), !piece.J0, volume, {piece.end.pressure});
    PetscFunctionReturn(PETSC_SUCCESS);
  }));
  PetscCall(weak.share(comm));
  if (!weak.found()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscSNPrintf(told, sizeof(told),
                          "-tissue %s with the parameters of a part of the lung (%.3g ml) takes no more than %.3g "
                          "cmH2O from rest by uniform inflation",
                          scene.tissue().law().name(), (double)(weak.volume / units::mm3_per_ml),
                          (double)(weak.told[0] / units::kPa_per_cmH2O)));
  text = told;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
