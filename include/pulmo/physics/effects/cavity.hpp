/// @file
/// Effect `cavity`: the lung touches the wall of a rigid cavity from inside, and slides along it without friction.
///
/// With the distance s(x) from the wall (positive inside) and the gap g = s(X + u) at a point of the surface, the wall
/// stores psi(q) per reference area at the penetration q = -g, and pushes with p = psi'(q) along its normal grad s:
///   p = 0 for q <= 0,  k q^2 / (2 w) for q < w,  k (q - w/2) beyond,
/// a penalty of stiffness k that begins smoothly over w (after Wriggers 2006, Laursen 2002). s has two continuous
/// derivatives, so force and tangent are exact derivatives of one energy: a wall does no work but what it stores, and
/// what it does depends on the state alone, not on the way there. With tension p = k q both ways.
///
/// The cavity is a closed surface of a file, or the shape of the mesh moved out: g = gap + s(X + u) - s(X) with the
/// distance s from the mesh's own boundary.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/closed_surface.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/signed_distance.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/follower_pressure.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

struct CavityKernels {
  struct Parameters {
    static constexpr const char *owner = "cavity";
    PetscScalar stiffness = 50; ///< k, kPa/mm
    PetscScalar onset = 0.05;   ///< w, mm
    PetscScalar gap = 5;        ///< at rest, where it is counted from there, mm
    PetscScalar from_rest = 1;  ///< 1: so it is; 0: the distance at rest is that of the file's surface
    PetscScalar tension = 0;    ///< 1: the wall holds the lung, too
    PetscScalar wall = 0;       ///< const SignedDistance *, as constants::to_scalar() packs it
    PetscScalar no_gap = 0;     ///< what a penetration is held to where there is no gap, mm
  };

  struct Contact {
    PetscScalar q;      ///< penetration, mm
    PetscScalar p, k;   ///< psi'(q), psi''(q) per reference area, kPa, kPa/mm
    PetscScalar energy; ///< psi(q), kPa mm
  };
  static Contact contact(PetscScalar distance, const Point &point, const Parameters &k)
  {
    const auto *wall = constants::to_pointer<const SignedDistance *>(k.wall);
    const PetscScalar q = k.from_rest != 0 ? wall->distance(point.x) - k.gap - distance : -distance, w = k.onset;
    if (k.tension != 0) return {q, k.stiffness * q, k.stiffness, k.stiffness * q * q / 2};
    if (q <= 0) return {q, 0, 0, 0};
    if (q < w) return {q, k.stiffness * q * q / (2 * w), k.stiffness * q / w, k.stiffness * q * q * q / (6 * w)};
    return {q, k.stiffness * (q - w / 2), k.stiffness, k.stiffness * (q * (q - w) / 2 + w * w / 6)};
  }
  static SignedDistance::Value distance(const Point &point, const Parameters &k)
  {
    const PetscScalar x[3] = {point.x[0] + point.u[0], point.x[1] + point.u[1], point.x[2] + point.u[2]};
    return constants::to_pointer<const SignedDistance *>(k.wall)->at(x);
  }

  /// f0 = d psi / du = -p grad s.
  static void push(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    const SignedDistance::Value s = distance(point, k);
    const Contact c = contact(s.distance, point, k);
    for (int i = 0; i < 3; ++i) f0[i] -= c.p * s.gradient[i];
  }
  static void push_by_displacement(const Point &point, const Parameters &k, PetscScalar g0[])
  {
    const SignedDistance::Value s = distance(point, k);
    const Contact c = contact(s.distance, point, k);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) g0[3 * i + j] += c.k * s.gradient[i] * s.gradient[j] - c.p * s.curvature[3 * i + j];
  }

  static PetscScalar stored(const Point &now, const Point &before, const Parameters &k)
  {
    return contact(distance(now, k).distance, now, k).energy - contact(distance(before, k).distance, before, k).energy;
  }
  /// What backward Euler loses: the push at the end of the step along the step, less what is stored, kPa mm.
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar f0[3] = {0, 0, 0}, work = 0;
    push(now, k, f0);
    for (int i = 0; i < 3; ++i) work += f0[i] * (now.u[i] - before.u[i]);
    return work - stored(now, before, k);
  }

  /// Penetration, pressure per reference area, area that touches per reference area, and penetration over the gap
  /// there.
  static void remember(const Point &point, const Parameters &k, PetscScalar value[])
  {
    const Contact c = contact(distance(point, k).distance, point, k);
    PetscScalar area[3] = {0, 0, 0}; // cof F N
    add_follower_pressure(point, 1, area);
    const bool touches = c.q > 0 || k.tension != 0;
    value[0] = touches ? c.q : 0;
    value[1] = c.p;
    value[2] = touches ? std::hypot(area[0], area[1], area[2]) : 0;
    value[3] = value[0] / (k.from_rest != 0 && k.gap > 0 ? k.gap : k.no_gap);
  }
};

class Cavity final : public Effect {
public:
  const char *name() const override { return "cavity"; }
  const char *about() const override { return "the lung slides in a rigid cavity and touches its wall"; }
  const char *absence() const override { return "no wall limits how far the lung moves"; }
  std::string example() const override
  {
    return "-cavity -cavity_gap 0.02 -cavity_spacing 1 -cavity_stiffness 2 -cavity_onset 0.05";
  }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    CavityKernels::Parameters &k = parameters_;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "the lung touches the wall of a rigid cavity", on_));
    options.group(name(), about(), on_, "-cavity");
    PetscCall(options.names("surfaces", "surfaces that touch it", surfaces_));
    PetscCall(options.text("file",
                           "closed surface of the cavity (.stl, .msh) in the mesh's axes; instead of the mesh's own "
                           "shape",
                           file_));
    PetscCall(options.flag("tension", "fluid holds the lung to the wall at its distance at rest", tension_));
    PetscCall(options.real("stiffness", "kPa/mm", Range::positive(), "pressure over penetration", k.stiffness));
    PetscCall(options.real("spacing", "mm", Range::not_negative(),
                           "of the grid that holds the wall; 0: a 128th of the cavity's size", spacing_));
    options.group(name(), "own shape", on_ && file_.empty() && !tension_,
                  "-cavity without -cavity_file and without -cavity_tension");
    PetscCall(options.real("gap", "mm", Range::not_negative(), "by which the mesh's own shape is moved out", k.gap));
    options.group(name(), "file", on_ && !file_.empty(), "-cavity_file");
    PetscCall(options.real("scale", "-", Range::positive(), "that makes the file's coordinates mm", scale_));
    options.group(name(), "one-sided contact", on_ && !tension_, "-cavity without -cavity_tension");
    PetscCall(options.real("onset", "mm", Range::positive(), "penetration over which the stiffness comes", k.onset));
    if (!on_ || file_.empty()) PetscFunctionReturn(PETSC_SUCCESS);
    PetscCall(read_closed_surface(options.comm(), "-cavity_file", file_, scale_, surface_));
    options.note_content("-cavity_file", "a closed surface, " + surface_.hash());
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(!surfaces_.empty(), options.comm(), "-cavity needs -cavity_surfaces NAME,...");
    PetscCall(mesh.require_surfaces(surfaces_, "-cavity_surfaces"));
    if (file_.empty()) PetscCall(boundary_of(mesh, "-cavity", surface_));
    for (const Options::Varying &v : options.varying())
      PulmoUserCheck(v.target != &parameters_.gap || !v.by_cell, options.comm(),
                     "-cavity_gap takes no values by cell: the wall is a surface; name parts of the mesh instead "
                     "(-cavity_gap 5,left_lung=8)");
    PetscCall(find_facets(options, mesh));
    PetscCall(build(options));
    if (!file_.empty())
      PetscCall(check_inside(options, mesh));
    else if (largest_gap_ > 0)
      PetscCall(check_folds(options, mesh));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = CavityKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    parameters_.from_rest = file_.empty() || tension_ ? 1 : 0;
    if (tension_) parameters_.gap = 0;
    parameters_.tension = tension_ ? 1 : 0;
    parameters_.no_gap = no_gap * std::cbrt(c.mesh().volume());
    parameters_.wall = constants::to_scalar(static_cast<const SignedDistance *>(&wall_));
    c.parameters(parameters_);
    for (const std::string &surface : surfaces_) {
      c.surface_residual("-p grad s . eta", surface, displacement, f0(surface_residual<P, K::push>));
      c.surface_jacobian("k grad s x grad s - p grad grad s", surface, displacement, displacement,
                         g0(surface_jacobian<P, K::push_by_displacement>));
      c.energy(Energy::stored, "elastic_cavity", surface, energy_density<P, K::stored>);
      c.energy(Energy::numerical, "numerical_dissipation", surface, energy_density<P, K::numerical>);
      c.remember({{"cavity_penetration", "mm"}, {"cavity_push", "kPa"}, {"cavity_touch", "1"}, {"cavity_give", "1"}},
                 remembered<P, K::remember>, surface);
      c.only_tell();
    }
    const std::size_t penetration = c.sum_up(0, Over::largest_of_facets, 1), push = c.sum_up(1, Over::facets, 1),
                      touch = c.sum_up(2, Over::facets, 1);
    c.signal("cavity_contact_cm2", [=](const SignalRow &row) { return row.integrals[touch] / mm2_per_cm2; });
    c.signal("cavity_pressure_cmH2O", [=](const SignalRow &row) {
      const double area = row.integrals[touch];
      return area > 0 ? row.integrals[push] / area / units::kPa_per_cmH2O : 0;
    });
    c.signal("cavity_penetration_mm", [=](const SignalRow &row) { return row.integrals[penetration]; });
    c.limit(PETSC_MAX_REAL, "");
    if (tension_) PetscFunctionReturn(PETSC_SUCCESS); // the lung may move as the fluid gives way
    constexpr PetscReal percent = 100, most = 10;
    const std::size_t give = c.sum_up(3, Over::largest_of_facets, percent);
    c.signal("cavity_penetration_percent", [=](const SignalRow &row) { return row.integrals[give]; });
    char told[300];
    PetscCall(
        PetscSNPrintf(told, sizeof(told),
                      "a penetration of more than %g %% of the gap there, or without a gap of %g %% of the lung's "
                      "size, says that the wall gives way; give a larger -cavity_stiffness, or no support that drives "
                      "the lung through it",
                      (double)most, (double)(most * no_gap)));
    c.limit(most, told);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  static constexpr PetscReal mm2_per_cm2 = 100;
  static constexpr PetscReal no_gap = 0.1; ///< of the lung's size: what counts as the gap where there is none

  struct Facet {
    PetscInt point; ///< of the mesh
    PetscReal gap;  ///< mm
  };
  /// Those that touch the wall, of this rank, and the largest of all gaps. A gap by surface comes before one by region.
  /// Collective.
  PetscErrorCode find_facets(const Options &options, const Mesh &mesh)
  {
    const bool gaps = file_.empty() && !tension_;
    std::vector<Mesh::Region> regions;
    std::vector<PetscInt> facets;
    std::vector<PetscReal> of_cell;
    PetscInt begin, end;

    PetscFunctionBeginUser;
    PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, &end));
    of_cell.assign(static_cast<std::size_t>(end - begin), gaps ? parameters_.gap : 0);
    const auto varying = std::find_if(options.varying().begin(), options.varying().end(),
                                      [&](const Options::Varying &v) { return v.target == &parameters_.gap; });
    const bool varies = gaps && varying != options.varying().end();
    if (varies) PetscCall(mesh.regions(regions));
    for (const Mesh::Region &region : regions)
      for (const auto &[part, value] : varying->by_name)
        if (part == region.name)
          for (const PetscInt c : region.cells) of_cell[static_cast<std::size_t>(c)] = value;
    facets_.clear();
    largest_gap_ = 0;
    for (const std::string &surface : surfaces_) {
      PetscCall(mesh.facets(surface, facets));
      for (const PetscInt facet : facets) {
        const PetscInt *cell;
        PetscCall(DMPlexGetSupport(mesh.dm(), facet, &cell));
        facets_.push_back({facet, of_cell[static_cast<std::size_t>(cell[0] - begin)]});
        if (varies)
          for (const auto &[part, value] : varying->by_name)
            if (part == surface) facets_.back().gap = value;
        largest_gap_ = std::max(largest_gap_, facets_.back().gap);
      }
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &largest_gap_, 1, MPIU_REAL, MPI_MAX, options.comm()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// Of the grid, mm.
  PetscReal spacing() const
  {
    constexpr PetscReal share = 1. / 128; // of the cavity's size
    return spacing_ > 0 ? spacing_ : share * surface_.size();
  }

  PetscErrorCode build(const Options &options)
  {
    constexpr double coarsest = 1. / 16; // of the cavity's size
    constexpr double share_lost = 0.05;  // of a spacing
    constexpr int margin = 8;            // spacings beyond the wall, for states on the way to a solution
    const PetscReal spacing = this->spacing(), reach = largest_gap_ + margin * spacing,
                    nodes = SignedDistance::nodes(surface_, spacing, reach);

    PetscFunctionBeginUser;
    PulmoUserCheck(spacing <= coarsest * surface_.size(), options.comm(),
                   "-cavity_spacing %g mm is too large for a cavity of %.3g mm: its shape would be lost; give %.2g mm "
                   "or less",
                   (double)spacing, surface_.size(), coarsest * surface_.size());
    PulmoUserCheck(
        nodes <= SignedDistance::most_nodes, options.comm(),
        "-cavity: a grid of %.3g mm around a cavity of %.3g mm and a gap of %.3g mm has %.2g nodes, more than "
        "%.2g; give a larger -cavity_spacing, or a smaller -cavity_gap",
        (double)spacing, surface_.size(), (double)largest_gap_, (double)nodes, SignedDistance::most_nodes);
    wall_.build(surface_, spacing, reach);
    const double departure = wall_.departure(surface_);
    if (departure > share_lost * spacing)
      PetscCall(PetscPrintf(options.comm(),
                            "pulmo: warning: -cavity: the wall is smoother than the surface it is made of, by %.3g mm "
                            "on average: details smaller than %.3g mm are lost; lower -cavity_spacing\n",
                            departure, (double)spacing));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// Refuses a lung that is not within the cavity at rest, and tells of a wall that is no wall of its chest.
  PetscErrorCode check_inside(const Options &options, const Mesh &mesh) const
  {
    struct {
      double distance;
      int rank;
    } own{PETSC_MAX_REAL, 0}, least{};
    double where[3] = {0, 0, 0};
    constexpr double far_larger = 10;
    // fluid keeps the distance at rest, whatever it is: two outlines of one lung may cross by what a grid rounds off
    const double size = std::cbrt(mesh.volume()), rounding = 1e-9 * size, outside = spacing();
    PetscReal low[3], high[3];

    PetscFunctionBeginUser;
    PetscCall(DMGetBoundingBox(mesh.dm(), low, high));
    const double across = std::hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]);
    PetscCallMPI(MPI_Comm_rank(options.comm(), &own.rank));
    for (const std::string &surface : surfaces_)
      PetscCall(mesh.visit_surface(surface, [&](const PetscReal x[3]) {
        const double distance = wall_.distance(x);
        if (distance >= own.distance) return;
        own.distance = distance;
        std::copy_n(x, 3, where);
      }));
    PetscCallMPI(MPI_Allreduce(&own, &least, 1, MPI_DOUBLE_INT, MPI_MINLOC, options.comm()));
    PetscCallMPI(MPI_Bcast(where, 3, MPI_DOUBLE, least.rank, options.comm()));
    PulmoUserCheck(
        least.distance >= -(tension_ ? outside : rounding), options.comm(),
        "-cavity_file %s: the lung is not within the cavity: near (%.4g, %.4g, %.4g) mm it is %.3g mm outside "
        "at rest; check the axes and -cavity_scale, enlarge the cavity, or lower -cavity_spacing (edges are "
        "rounded off over a spacing)",
        file_.c_str(), where[0], where[1], where[2], -least.distance);
    if (least.distance > size)
      PetscCall(PetscPrintf(options.comm(),
                            "pulmo: warning: -cavity_file %s: the wall is %.3g mm or more away from the lung, which is "
                            "not as large itself; check -cavity_scale\n",
                            file_.c_str(), least.distance));
    else if (surface_.size() > far_larger * across)
      PetscCall(
          PetscPrintf(options.comm(),
                      "pulmo: warning: -cavity_file %s: the cavity is %.3g mm across, and the lung %.3g mm; check "
                      "-cavity_scale\n",
                      file_.c_str(), surface_.size(), across));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// Tells where the moved wall is not at the gap along the normal: where the surface folds, walls meet before.
  PetscErrorCode check_folds(const Options &options, const Mesh &mesh) const
  {
    constexpr double there = 0.75, told = 0.05; // of the gap; of the area
    double area[2] = {0, 0}, gap = 0;           // of all, of what folds, mm^2; the largest there, mm

    PetscFunctionBeginUser;
    for (const Facet &facet : facets_) {
      PetscReal measure, middle[3], moved[3], normal[3];
      PetscCall(DMPlexComputeCellGeometryFVM(mesh.dm(), facet.point, &measure, middle, normal));
      const SignedDistance::Value s = wall_.at(middle);
      const double inward = s.gradient[0] * normal[0] + s.gradient[1] * normal[1] + s.gradient[2] * normal[2];
      for (int d = 0; d < 3; ++d) moved[d] = middle[d] - std::copysign(facet.gap, inward) * normal[d];
      area[0] += measure;
      if (facet.gap <= 0 || s.distance - wall_.distance(moved) >= there * facet.gap) continue;
      area[1] += measure;
      gap = std::max<double>(gap, facet.gap);
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, area, 2, MPI_DOUBLE, MPI_SUM, options.comm()));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &gap, 1, MPI_DOUBLE, MPI_MAX, options.comm()));
    if (area[1] > told * area[0])
      PetscCall(
          PetscPrintf(options.comm(),
                      "pulmo: warning: -cavity_gap %g mm: on %.2g %% of the surface the wall is not there: the "
                      "surface folds, or parts of it are closer to each other, and their cavities are one; give a "
                      "smaller gap, or the cavity's surface by -cavity_file\n",
                      gap, 100 * area[1] / area[0]));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  bool on_ = false, tension_ = false;
  std::vector<std::string> surfaces_{"pleura"};
  std::string file_;
  PetscReal spacing_ = 0, scale_ = 1;
  ClosedSurface surface_; ///< that the wall is made of
  SignedDistance wall_;
  std::vector<Facet> facets_; ///< that touch it
  PetscReal largest_gap_ = 0; ///< mm
  mutable CavityKernels::Parameters parameters_;
};

} // namespace pulmo
