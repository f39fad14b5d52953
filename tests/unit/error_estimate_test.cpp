// Error bars from differences between runs, on numbers whose limits are known.
#include "pulmo/program/error_estimate.hpp"

#include <cmath>
#include <gtest/gtest.h>

namespace pulmo {
namespace {

TEST(TimeError, BracketsASeriesOfKnownOrder)
{
  for (int order : {1, 2})
    for (double next : {0.0, 0.1, -0.1}) { // share of the next power
      const double limit = 84.2, h = 0.1;
      const auto number = [&](double dt) {
        return limit + 3 * std::pow(dt, order) + next * 3 * std::pow(dt, order + 1);
      };
      const TimeError e = time_error(number(h), number(2 * h), number(4 * h), order);
      const double truth = std::abs(number(h) - limit);
      ASSERT_TRUE(e.order);
      EXPECT_NEAR(*e.order, order, 0.1 * order);
      EXPECT_GE(e.error, truth) << "order " << order << ", next " << next;
      EXPECT_LE(e.error, 1.5 * truth) << "order " << order << ", next " << next;
    }
}

TEST(TimeError, AnOrderFarFromTheSchemesIsTrustedLess)
{
  const double limit = 2;
  const auto number = [&](double dt) { return limit + 5 * dt; };
  const TimeError e = time_error(number(0.1), number(0.2), number(0.4), 2); // a scheme of order 2 held up by a kink
  EXPECT_NEAR(*e.order, 1, 1e-9);
  EXPECT_NEAR(e.error, 3 * 0.5, 1e-9);
  const auto slow = [&](double dt) { return limit + std::pow(dt, 0.1); };
  const TimeError s = time_error(slow(0.1), slow(0.2), slow(0.4), 1); // never below order 1/2
  EXPECT_NEAR(s.error, 3 * (slow(0.2) - slow(0.1)) / (std::sqrt(2.0) - 1), 1e-9);
}

TEST(TimeError, NumbersThatSwing)
{
  const TimeError e = time_error(1.0, 1.1, 0.8, 1);
  EXPECT_FALSE(e.order);
  EXPECT_NEAR(e.error, 1.25 * 0.3, 1e-12);
  EXPECT_EQ(time_error(6, 6, 6, 1).error, 0);
  EXPECT_NEAR(time_error(6, 6, 5, 1).error, 1.25, 1e-12);
  EXPECT_NEAR(time_error(6, 5, 5, 1).error, 1.25, 1e-12);
}

TEST(SpaceError, HoldsTheErrorOfOrderOneOrMore)
{
  for (double ratio : {0.5, 0.7, 1.4, 2.0}) {
    const auto error = [](double h, int order) { return 4 * std::pow(h, order); };
    EXPECT_NEAR(space_error(error(0.3, 1) - error(0.3 * ratio, 1), ratio), 1.25 * error(0.3, 1), 1e-12);
    EXPECT_GE(space_error(error(0.3, 2) - error(0.3 * ratio, 2), ratio), error(0.3, 2));
  }
}

TEST(ErrorBar, IsTheSumOfItsPartsOrUnknown)
{
  ErrorBar bar;
  bar.time = 1;
  bar.space = 2;
  bar.solver = 0.25;
  EXPECT_NEAR(*bar.total(), 3.25, 1e-15);
  bar.space.reset();
  EXPECT_FALSE(bar.total());
}

TEST(LackingBar, CountsPartsThatMayCancelApart)
{
  const ClinicalEntry entry{"tidal_volume_ml", "tidal volume", "ml", 500};
  LackingParts parts;
  parts.steps = 3;
  parts.rows = -1;
  parts.flow_in_space = -6;
  parts.tissue_in_space = 3;
  parts.solver = -0.5;
  const ErrorBar bar = lacking_bar(entry, parts, 0.2, {});
  EXPECT_NEAR(*bar.time, 1.5 * 4, 1e-12);
  EXPECT_NEAR(*bar.space, 1.2 * 1.5 * 9 / 0.75, 1e-12);
  EXPECT_NEAR(*bar.solver, 0.5, 1e-12);
  EXPECT_NEAR(*bar.corrected, 500 + 2 - 3 / 0.75 - 0.5, 1e-12);
  EXPECT_NEAR(*bar.corrected_error, *bar.total() / 3, 1e-12);
  EXPECT_TRUE(bar.unresolved.empty());
}

TEST(LackingBar, SaysWhatIsNotResolved)
{
  const ClinicalEntry entry{"tidal_volume_ml", "tidal volume", "ml", 500};
  LackingParts parts;
  parts.flow_in_space = 40; // 53 of 500
  EXPECT_NEAR(space_share(entry, parts), 40 / 0.75 / 500, 1e-12);
  ErrorBar bar = lacking_bar(entry, parts, 0.2, {});
  EXPECT_FALSE(bar.space);
  EXPECT_FALSE(bar.total());
  EXPECT_FALSE(bar.corrected);
  EXPECT_EQ(bar.unresolved_words(), "cells too large");
  bar = lacking_bar(entry, parts, 0.2, Unresolved::few_steps_in_a_phase);
  EXPECT_FALSE(bar.time);
  EXPECT_EQ(bar.unresolved_words(), "steps too long for its phases, cells too large");
  EXPECT_STREQ(key_of(bar.unresolved.front()), "few_steps_in_a_phase");
  EXPECT_STREQ(key_of(Unresolved::cells_too_large), "cells_too_large"); // the last one
  parts.flow_in_space = 4; // 1 %, but another number is off by several times itself
  EXPECT_TRUE(lacking_bar(entry, parts, 3, {}).space);
  bar = lacking_bar(entry, parts, 3.1, {});
  EXPECT_FALSE(bar.space);
  EXPECT_EQ(bar.unresolved_words(), "cells too large");
  parts.flow_in_space = 1e-12; // prescribed
  EXPECT_TRUE(lacking_bar(entry, parts, 3.1, {}).space);
  parts.steps = std::nan("");
  EXPECT_FALSE(lacking_bar(entry, parts, 0.2, {}).time);
}

} // namespace
} // namespace pulmo
