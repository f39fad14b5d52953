// How far the tissue of a scene goes, beside the pressures of its run.
#include "pulmo/base/units.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/physics/effects/recruitment.hpp"
#include "pulmo/physics/law_range.hpp"
#include "pulmo/physics/parameter_fields.hpp"
#include "pulmo/program/scene_view.hpp"

#include <algorithm>
#include <cmath>
#include <map>

namespace pulmo {

namespace {

/// More sets of parameters than this are told by the softest and the stiffest.
constexpr std::size_t most_sets = 6;

/// J of a lung at total capacity over that at rest.
constexpr PetscReal full_lung = 2.5;

using Row = std::vector<PetscReal>;

std::string number(PetscReal value, int digits = 3)
{
  char text[40];
  std::snprintf(text, sizeof(text), "%.*g", digits, (double)value);
  return text;
}

/// Pressures and volumes that the ventilator prescribes.
struct Prescribed {
  bool pressures = false;
  PetscReal lowest = 0, highest = 0; ///< kPa
  PetscReal volume = 0;              ///< the most that flow phases in a row deliver, mm^3

  explicit Prescribed(const Programme *programme)
  {
    PetscReal delivered = 0;
    if (!programme) return;
    for (const Phase &phase : programme->phases()) {
      if (phase.control == Control::flow) {
        delivered += phase.delivered(phase.end);
        volume = std::max(volume, delivered);
        continue;
      }
      delivered = 0;
      if (programme->breathes() && phase.breath == 0) continue;
      lowest = pressures ? std::min(lowest, phase.to) : phase.to;
      highest = pressures ? std::max(highest, phase.to) : phase.to;
      pressures = true;
    }
  }
};

/// The largest suction of the muscles in a run, kPa.
PetscReal largest_suction(const SceneFacts &facts, const PetscScalar constants[], PetscReal end)
{
  constexpr int looks = 2000;
  PetscReal largest = 0;
  for (int i = 0; facts.pleural_suction && i <= looks; ++i)
    largest = std::max(largest, facts.pleural_suction(end * i / looks, constants));
  return largest;
}

/// What recruitment makes of the volume, over that with what is open in the mesh: all closed, all open.
struct Recruited {
  PetscReal least = 1, most = 1;

  /// Of the whole lung. Collective.
  PetscErrorCode find(const Composition &composition)
  {
    using P = RecruitmentKernels::Parameters;
    const DM dm = composition.mesh().dm();
    std::vector<PetscScalar> all = composition.constants(Step());
    PetscReal extremes[2] = {-1, 1}; // -least, most
    PetscInt begin, end;

    PetscFunctionBeginUser;
    if (constants::offset_of(constants::tag(P::owner), all.data()) <= 0) PetscFunctionReturn(PETSC_SUCCESS);
    PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
    for (PetscInt c = 0; c < end - begin; ++c) {
      if (composition.varying()) composition.varying()->patch(c, "", all);
      const P k = constants::get<P>(all.data());
      extremes[0] = std::max(extremes[0], -RecruitmentKernels::volume_ratio(0, k));
      extremes[1] = std::max(extremes[1], RecruitmentKernels::volume_ratio(1, k));
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, extremes, 2, MPIU_REAL, MPI_MAX, PetscObjectComm((PetscObject)dm)));
    least = -extremes[0];
    most = extremes[1];
    PetscFunctionReturn(PETSC_SUCCESS);
  }
};

/// Tissue with one set of parameters.
struct Part {
  Row row;              ///< what differs from place to place
  PetscReal volume = 0; ///< mm^3
  PetscReal stiffness;  ///< dp/dJ at rest, kPa
};

/// The sets of parameters of the lung.
class Parts {
public:
  Parts(const Scene &scene, const Model &model) : law_(scene.tissue().law()), facts_(scene.facts()), model_(model)
  {
    const Composition &composition = model.composition();
    base_ = composition.constants(Step());
    if (!composition.varying()) return;
    const std::vector<PetscInt> &all = composition.varying()->offsets();
    for (std::size_t i = 0; i < all.size(); ++i)
      for (const ParameterBlock &block : composition.parameter_blocks()) {
        const PetscInt begin = constants::offset_of(constants::tag(block.owner), base_.data());
        const std::string owner = block.owner;
        if ((owner == "tissue" || owner == "prestress") && all[i] >= begin && all[i] < begin + block.count) {
          which_.push_back(i);
          offsets_.push_back(all[i]);
        }
      }
  }

  /// Collective.
  PetscErrorCode find()
  {
    const Composition &composition = model_.composition();
    const DM dm = composition.mesh().dm();
    const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
    std::map<Row, PetscReal> volumes;
    PetscInt begin, end;
    int many;

    PetscFunctionBeginUser;
    if (which_.empty()) {
      parts_ = {part({}, composition.mesh().volume())};
      PetscFunctionReturn(PETSC_SUCCESS);
    }
    PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
    for (PetscInt c = begin; c < end; ++c) {
      Row all, own;
      PetscReal volume;
      composition.varying()->append(c - begin, "", all);
      for (const std::size_t i : which_) own.push_back(all[i]);
      PetscCall(DMPlexComputeCellGeometryFVM(dm, c, &volume, nullptr, nullptr));
      volumes[own] += volume;
    }
    many = thin_out(volumes);
    std::vector<PetscReal> mine, everyone;
    for (const auto &[row, volume] : volumes) {
      mine.insert(mine.end(), row.begin(), row.end());
      mine.push_back(volume);
    }
    PetscCall(gather(comm, mine, everyone));
    volumes.clear();
    for (std::size_t i = 0; i < everyone.size(); i += which_.size() + 1)
      volumes[Row(everyone.begin() + i, everyone.begin() + i + which_.size())] += everyone[i + which_.size()];
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &many, 1, MPI_INT, MPI_LOR, comm));
    many_ = thin_out(volumes) || many;
    if (many_) keep_extremes(volumes);
    for (const auto &[row, volume] : volumes) parts_.push_back(part(row, volume));
    std::sort(parts_.begin(), parts_.end(), [](const Part &a, const Part &b) { return a.stiffness < b.stiffness; });
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  const std::vector<Part> &parts() const { return parts_; }
  bool many() const { return many_; }
  /// The constants of a part; the law is that of its stress-free shape.
  std::vector<PetscScalar> constants_of(const Row &row) const
  {
    std::vector<PetscScalar> all = base_;
    for (std::size_t i = 0; i < row.size(); ++i) all[static_cast<std::size_t>(offsets_[i])] = row[i];
    StressFree::forget(all);
    return all;
  }
  /// Volume of the mesh over that of the unloaded piece.
  PetscReal stretch_of(const std::vector<PetscScalar> &constants) const
  {
    if (!facts_.prestress) return 1;
    return inflated_J(law_, facts_.prestress->pressure, constants.data()).value_or(1); // it was checked to be there
  }

private:
  Part part(const Row &row, PetscReal volume) const
  {
    return {row, volume, inflation_stiffness(law_, 1, constants_of(row).data())};
  }
  bool thin_out(std::map<Row, PetscReal> &volumes) const
  {
    if (volumes.size() <= most_sets) return false;
    keep_extremes(volumes);
    return true;
  }
  void keep_extremes(std::map<Row, PetscReal> &volumes) const
  {
    std::vector<Part> all;
    for (const auto &[row, volume] : volumes) all.push_back(part(row, volume));
    const auto [least, most] = std::minmax_element(
        all.begin(), all.end(), [](const Part &a, const Part &b) { return a.stiffness < b.stiffness; });
    volumes = {{least->row, least->volume}, {most->row, most->volume}};
  }
  static PetscErrorCode gather(MPI_Comm comm, const std::vector<PetscReal> &mine, std::vector<PetscReal> &everyone)
  {
    PetscMPIInt size, n = static_cast<PetscMPIInt>(mine.size()), total = 0;

    PetscFunctionBeginUser;
    PetscCallMPI(MPI_Comm_size(comm, &size));
    std::vector<PetscMPIInt> counts(static_cast<std::size_t>(size)), starts;
    PetscCallMPI(MPI_Allgather(&n, 1, MPI_INT, counts.data(), 1, MPI_INT, comm));
    for (const PetscMPIInt count : counts) {
      starts.push_back(total);
      total += count;
    }
    everyone.resize(static_cast<std::size_t>(total));
    PetscCallMPI(
        MPI_Allgatherv(mine.data(), n, MPIU_REAL, everyone.data(), counts.data(), starts.data(), MPIU_REAL, comm));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  const TissueLaw &law_;
  const SceneFacts &facts_;
  const Model &model_;
  std::vector<PetscScalar> base_;
  std::vector<std::size_t> which_; ///< of the varying parameters: those of the tissue's stress
  std::vector<PetscInt> offsets_;  ///< their places among the constants
  std::vector<Part> parts_;
  bool many_ = false;
};

/// Uniform inflation of one part, as the run counts it: the pressure of the gas, J by the volume of the mesh.
class Inflation {
public:
  Inflation(const TissueLaw &law, std::vector<PetscScalar> constants, PetscReal stretch, PetscReal prestress)
      : law_(law), constants_(std::move(constants)), stretch_(stretch), prestress_(prestress)
  {}

  /// "J = 1.5 (12 cmH2O)"
  std::string text(const LawRange::State &state) const
  {
    return "J = " + number(state.J / stretch_) + " (" + cmH2O(state.pressure - prestress_) + ")";
  }
  std::string range() const
  {
    const LawRange r = law_range(law_, constants_.data());
    std::string text_of = r.largest ? "it holds no more than " + cmH2O(r.largest->pressure - prestress_) +
                                          ", at J = " + number(r.largest->J / stretch_)
                                    : "it holds any pressure up to J = " + number(LawRange::largest_J / stretch_);
    if (r.least) text_of += ", and no suction beyond " + cmH2O(r.least->pressure - prestress_);
    if (r.softest)
      text_of += "; it is softest at " + text(*r.softest) + ", where dp/dJ is " + number(100 * r.softest_share, 2) +
                 " % of that at rest, and stiffens beyond";
    else
      text_of += r.largest ? "; it softens up to there" : "; it stiffens from rest on";
    if (r.waves_below) text_of += "; below " + text(*r.waves_below) + " it is not elliptic (shears by itself)";
    if (r.waves_above) text_of += "; above " + text(*r.waves_above) + " it is not elliptic (shears by itself)";
    if (!r.waves_below && !r.waves_above) text_of += "; it is elliptic throughout";
    return text_of;
  }
  std::string at_pressure(const std::string &name, PetscReal pressure) const
  {
    const auto J = inflated_J(law_, pressure + prestress_, constants_.data());
    const std::string what = name + " " + cmH2O(pressure);
    if (!J) return what + ": beyond what it holds";
    return what + ": J = " + number(*J / stretch_);
  }
  std::string at_J(PetscReal J) const
  {
    return cmH2O(inflation_pressure(law_, J * stretch_, constants_.data()) - prestress_);
  }
  PetscReal J_at(PetscReal pressure) const
  {
    return inflated_J(law_, pressure + prestress_, constants_.data()).value_or(PETSC_MAX_REAL) / stretch_;
  }

private:
  static std::string cmH2O(PetscReal kPa)
  {
    const PetscReal p = kPa / units::kPa_per_cmH2O;
    return number(std::abs(p) < 1e-9 ? 0 : p) + " cmH2O";
  }

  const TissueLaw &law_;
  std::vector<PetscScalar> constants_;
  PetscReal stretch_, prestress_;
};

} // namespace

PetscErrorCode describe_range(const Scene &scene, const Model &model, std::vector<std::string> &lines)
{
  const SceneFacts &facts = scene.facts();
  const TissueLaw &law = scene.tissue().law();
  const Prescribed prescribed(facts.ventilator.get());
  const PetscReal prestress = facts.prestress ? facts.prestress->pressure : 0, volume = scene.mesh().volume(),
                  end = facts.ventilator ? facts.ventilator->phases().back().end : 1,
                  muscles = largest_suction(facts, model.composition().constants(Step()).data(), end);
  Parts parts(scene, model);
  Recruited recruited;

  PetscFunctionBeginUser;
  PetscCall(parts.find());
  PetscCall(recruited.find(model.composition()));
  lines.emplace_back(
      "A piece of tissue that inflates alone and evenly, without springs, weight, film or neighbours; J is "
      "its volume over that in the mesh.");
  if (facts.prestress)
    lines.push_back("In the mesh it is under " + number(prestress / units::kPa_per_cmH2O) +
                    " cmH2O already (-prestress); pressures count from there.");
  if (recruited.most > 1 || recruited.least < 1)
    lines.push_back("What opens and closes (-recruitment) is not in it, either: at each pressure J is up to " +
                    number(recruited.most) + " times what is told once all is open, and " + number(recruited.least) +
                    " times where all is closed.");
  if (parts.many())
    lines.emplace_back("Its parameters differ from place to place; these are the softest and the stiffest at rest.");
  bool wide = false;
  for (const Part &part : parts.parts()) {
    const std::vector<PetscScalar> constants = parts.constants_of(part.row);
    const Inflation inflation(law, constants, parts.stretch_of(constants), prestress);
    const bool one = parts.parts().size() == 1;
    const std::string where =
        one ? std::string()
            : (parts.many() ? std::string("Where")
                            : "in the " + number(part.volume / units::mm3_per_ml, 4) + " ml where") +
                  " dp/dJ at rest is " + number(part.stiffness) + " kPa: ";
    lines.push_back("-tissue " + std::string(law.name()) + (one ? ": " : ", ") + where + inflation.range() + ".");
    std::string told;
    if (prescribed.pressures) {
      told = inflation.at_pressure("at the lowest pressure of the ventilator,", prescribed.lowest) + "; " +
             inflation.at_pressure("at the highest,", prescribed.highest);
      wide = wide || inflation.J_at(prescribed.highest + muscles) * recruited.most > full_lung;
    }
    if (muscles > 0)
      told += (told.empty() ? "" : "; ") +
              inflation.at_pressure("with all that the muscles pull,", prescribed.highest + muscles);
    if (prescribed.volume > 0) {
      const PetscReal J = 1 + prescribed.volume / volume;
      told += (told.empty() ? "" : "; ") + ("with the " + number(prescribed.volume / units::mm3_per_ml, 4)) +
              " ml that the ventilator delivers, spread evenly, J = " + number(J) + " at " + inflation.at_J(J);
      wide = wide || J > full_lung;
    }
    if (!told.empty()) lines.push_back((one ? "There: " : "There, ") + told + ".");
  }
  if (wide)
    lines.push_back(
        "A full lung has about " + number(full_lung) +
        " times the volume that it has at rest: J beyond that is no lung's, unless springs take the pressure.");
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode warn_beyond_law(MPI_Comm comm, const Scene &scene, const Model &model)
{
  // who neither holds the lung nor changes what its tissue holds; with gas on the airway wall it is not quite free
  static constexpr const char *bystanders[] = {"tissue", "airflow",     "ventilator",      "support",
                                               "tube",   "airway_tree", "pressure_damping"};
  const Composition &composition = model.composition();
  const TissueLaw &law = scene.tissue().law();
  const Prescribed prescribed(scene.facts().ventilator.get());
  LawRange::State end;

  PetscFunctionBeginUser;
  if (!prescribed.pressures || composition.varying() || !composition.bearing_surfaces().empty())
    PetscFunctionReturn(PETSC_SUCCESS);
  for (const Effect *effect : scene.active()) {
    const std::string name = effect->name();
    if (std::find(std::begin(bystanders), std::end(bystanders), name) == std::end(bystanders))
      PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (prescribed.highest <= 0 || inflated_J(law, prescribed.highest, nullptr, &end)) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscPrintf(
      comm,
      "pulmo: warning: nothing but its tissue holds this lung, and -tissue %s with these parameters holds no more than "
      "%.3g cmH2O by uniform inflation, at J = %.3g, where the ventilator gives %.3g cmH2O: held there the lung fills "
      "without end; give a lower pressure, springs (-chest_wall), another law or other parameters\n",
      law.name(), (double)(end.pressure / units::kPa_per_cmH2O), (double)end.J,
      (double)(prescribed.highest / units::kPa_per_cmH2O)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
