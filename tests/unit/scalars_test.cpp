// Scalar unknowns and partners: equations of a tree, Newton's elimination, verdicts on attempts.
#include "unit/scenes.hpp"

#include "pulmo/physics/effects/airway_tree.hpp"

namespace pulmo::test {
namespace {

// ------------------------------------------------------------------------------------------ equations

AirwayNetwork network()
{
  // a trunk with a wall, two branches at its end, another branch from the opening
  return AirwayNetwork({{"trunk", -1, 2, 0, 0.7, {}},
                        {"right", 0, 3, 0.5, 0, {{"x0", ""}}},
                        {"left", 0, 1, 4, 0.3, {{"x1", ""}}},
                        {"other", -1, 5, 0, 0, {{"y0", ""}}}});
}

TEST(AirwayNetwork, DerivativesOfItsEquations)
{
  const AirwayNetwork tree = network();
  const std::size_t n = tree.branches().size();
  ScalarState s{0.9, {0.5, 0.3, 0.2, 0.4}, {0.3, -0.2, 0.6, 0.1}, {0, 2.2, -0.4, 1.7}};
  ScalarRows rows(n);
  tree.equations(s, rows);
  const auto by = [&](double &x, std::size_t equation) {
    return derivative(
        [&](double h) {
          const double before = x;
          ScalarRows moved(n);
          x += h;
          tree.equations(s, moved);
          x = before;
          return moved.value[equation];
        },
        1e-3);
  };
  for (std::size_t i = 0; i < n; ++i) {
    EXPECT_NEAR(rows.by_opening[i], by(s.opening, i), 1e-8) << i;
    for (std::size_t j = 0; j < n; ++j) {
      EXPECT_NEAR(rows.by_value(i, j), by(s.value[j], i), 1e-8) << i << " " << j;
      EXPECT_NEAR(rows.by_rate(i, j), by(s.rate[j], i), 1e-8) << i << " " << j;
      EXPECT_NEAR(rows.by_flow(i, j), by(s.flow[j], i), 1e-8) << i << " " << j;
    }
  }
}

// --------------------------------------------------------------------------------------------- Newton

TEST(ScalarUnknowns, TheWholeNewtonStepConvergesQuadratically)
{
  // one step from rest: an elimination that misses a derivative would crawl to 1e-12
  for (const char *mode : {"pcv", "vcv common_pressure"})
    for (const char *surfaces : {"x1", "x1,x0"})
      for (const char *resistance : {"0", "1e3", "1e6", "1e9"}) {
        SceneSpec scene;
        scene.ventilator = scene.airflow = true;
        scene.mode = mode;
        scene.chest_wall = "full";
        scene.law = "yoshihara";
        scene.more =
            std::string("-airflow_surfaces ") + surfaces + " -airway_tree star -airway_tree_resistance " + resistance;
        SCOPED_TRACE(scene.text());
        const Registry registry = Registry::standard();
        SceneRun run(registry);
        bool finished = false;
        PULMO_OK(prepare(run, "-options_file " + source("petsc_options/solvers/tight.opts") + " " + scene.options() +
                                  (scene.mode == "pcv" ? " -ventilator_ramp 0 -ventilator_pip 3"
                                                       : " -ventilator_tidal_volume 4e-3") +
                                  " -ts_max_time 0.05"));
        PULMO_OK(run.simulation().run(finished));
        ASSERT_TRUE(finished) << run.simulation().failure_text();
        const SignalRow &row = run.simulation().rows().back();
        EXPECT_LE(row.newton, 6);
        EXPECT_GE(row.newton, 2);
        ASSERT_EQ(row.scalars.size(), std::string(surfaces) == "x1" ? 1u : 2u);
        double flow = 0;
        for (std::size_t k = 0; k < row.scalars.size(); ++k) {
          EXPECT_NEAR(row.pressure - row.scalars[k], std::stod(resistance) * row.scalar_flows[k] / 1000,
                      1e-8 * row.pressure);
          flow += row.scalar_flows[k];
        }
        EXPECT_NEAR(flow, row.flow, 1e-9 * row.flow);
      }
}

// ------------------------------------------------------------------------------------------- partners

/// Counts, and answers as it was told.
class Metronome final : public Partner {
public:
  struct Notes {
    int begun = 0, judged = 0, again = 0, shorter = 0, accepted = 0;
    PetscReal longest = 0, last = 0;
  };
  Metronome(PetscReal longest, bool twice, Notes &notes) : longest_(longest), twice_(twice), notes_(notes) {}
  const char *name() const override { return "metronome"; }
  void begin(PetscReal, PetscReal) override { ++notes_.begun; }
  Verdict judge(const Attempt &attempt) override
  {
    ++notes_.judged;
    if (attempt.dt > longest_ * (1 + 1e-9)) return Verdict::shorter;
    if (twice_ && !retaken_) return Verdict::again;
    return Verdict::kink;
  }
  std::string why() const override { return "faster than the metronome"; }
  void reject(Verdict how) override
  {
    retaken_ = how == Verdict::again;
    ++(how == Verdict::again ? notes_.again : notes_.shorter);
  }
  void accept(const Attempt &attempt) override
  {
    retaken_ = false;
    ++notes_.accepted;
    notes_.longest = std::max(notes_.longest, attempt.dt);
    notes_.last = attempt.time;
  }

private:
  PetscReal longest_;
  bool twice_, retaken_ = false;
  Notes &notes_;
};

/// Brings a metronome where -metronome_longest is given.
class MetronomeEffect final : public Effect {
public:
  static Metronome::Notes notes;
  const char *name() const override { return "metronome"; }
  const char *about() const override { return "a partner of the steps"; }
  bool active() const override { return longest_ > 0; }
  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.real("longest", "s", Range::not_negative(), "longest step", longest_));
    PetscCall(options.flag("twice", "each step is made twice", twice_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  std::vector<std::unique_ptr<Partner>> partners(const SceneFacts &) const override
  {
    std::vector<std::unique_ptr<Partner>> list;
    list.push_back(std::make_unique<Metronome>(longest_, twice_, notes));
    return list;
  }

private:
  PetscReal longest_ = 0;
  bool twice_ = false;
};
Metronome::Notes MetronomeEffect::notes;

TEST(Partners, AttemptsAreTakenAgainOrShorterAsTheyAsk)
{
  SceneSpec scene;
  scene.ventilator = scene.airflow = true;
  scene.chest_wall = "full";
  scene.law = "yoshihara";
  Registry registry = Registry::standard();
  registry.effect<MetronomeEffect>();
  const std::string text = "-options_file " + source("petsc_options/solvers/tight.opts") + " " + scene.options() +
                           " -ts_dt 0.05 -ts_max_time 0.2 ";
  std::vector<double> volumes;
  for (const char *more : {"-ts_dt 0.0125", "-metronome_longest 0.0125", "-metronome_longest 0.05 -metronome_twice"}) {
    SCOPED_TRACE(more);
    SceneRun run(registry);
    bool finished = false;
    MetronomeEffect::notes = {};
    PULMO_OK(prepare(run, text + more));
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    const Metronome::Notes &notes = MetronomeEffect::notes;
    const auto rows = static_cast<int>(run.simulation().rows().size()) - 1;
    volumes.push_back(run.simulation().rows().back().volume);
    if (notes.begun == 0) continue; // without a metronome
    EXPECT_EQ(notes.accepted, rows);
    EXPECT_NEAR(notes.last, 0.2, 1e-12);
    EXPECT_GE(notes.begun, notes.judged);
    if (std::string(more).find("twice") != std::string::npos) {
      EXPECT_EQ(notes.again, rows);
      EXPECT_EQ(notes.shorter, 0);
      EXPECT_EQ(run.simulation().rejected_steps(), 0);
    } else {
      EXPECT_LE(notes.longest, 0.0125 * (1 + 1e-9));
      EXPECT_GT(notes.shorter, 0);
      EXPECT_EQ(notes.shorter, run.simulation().rejected_steps());
    }
  }
  EXPECT_NEAR(volumes[1], volumes[0], 2e-2 * volumes[0]); // steps of much the same size
}

} // namespace
} // namespace pulmo::test
