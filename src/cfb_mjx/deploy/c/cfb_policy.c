/* See cfb_policy.h: the guards around what flies. */
#include "cfb_policy.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "cfb_data.h"
#include "cfb_pilot.h"

static int started, blind, frozen;
static float before[13];
static cfb_fault_t fault;
static float last[4];

void cfb_policy_reset(void) {
  started = 0;
  blind = 0;
  frozen = 0;
  fault = CFB_FINE;
  memset(last, 0, sizeof last);
  cfb_pilot_reset();
}

float cfb_policy_dt(void) { return CFB_DT_S; }

cfb_fault_t cfb_policy_fault(void) { return fault; }

/* By its bits, which no compiler option makes disappear: those of 1e6, NaN and infinity are larger. */
static int sensible(const float *values, int length) {
  for (int i = 0; i < length; i++) {
    uint32_t bits;
    memcpy(&bits, &values[i], sizeof bits);
    if ((bits & 0x7fffffffu) > @LARGEST_BITS@u) return 0;
  }
  return 1;
}

/* Whether the estimate has been the same for so long that the estimator must have stopped: a drone that moves does not
 * stay where it is. */
static int has_frozen(const float *position, const float *velocity, const float *quaternion, const float *rate) {
  float now[13];
  memcpy(now, position, 3 * sizeof *now);
  memcpy(now + 3, velocity, 3 * sizeof *now);
  memcpy(now + 6, quaternion, 4 * sizeof *now);
  memcpy(now + 10, rate, 3 * sizeof *now);
  int moves = 0;
  for (int i = 0; i < 3; i++) moves |= now[3 + i] < 0.0f || now[3 + i] > 0.0f || now[10 + i] < 0.0f || now[10 + i] > 0.0f;
  frozen = started && moves && memcmp(now, before, sizeof now) == 0 ? frozen + 1 : 0;
  memcpy(before, now, sizeof now);
  return frozen >= CFB_POLICY_FROZEN_STEPS;
}

void cfb_policy_step(const float position[3], const float velocity[3], const float quaternion_wxyz[4],
                     const float body_rate[3], const float target[3], float command[4]) {
  const float *const q = quaternion_wxyz;
  int good = sensible(position, 3) && sensible(velocity, 3) && sensible(q, 4) && sensible(body_rate, 3) &&
             sensible(target, 3);
  const float norm = good ? sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) : 0.0f;
  good = norm > 1e-6f;
  if (fault != CFB_STOPPED) {
    blind = good ? 0 : blind + 1;
    fault = good ? CFB_FINE : (started && blind <= CFB_POLICY_BLIND_STEPS ? CFB_BLIND : CFB_STOPPED);
    if (good && has_frozen(position, velocity, q, body_rate)) fault = CFB_STOPPED;
  }
  if (fault == CFB_FINE) {
    cfb_estimate_t estimate;
    for (int i = 0; i < 3; i++) {
      estimate.position[i] = position[i] - target[i];
      estimate.velocity[i] = velocity[i];
      estimate.body_rate[i] = body_rate[i];
    }
    for (int i = 0; i < 4; i++) estimate.quaternion[i] = q[i] / norm;
    if (!started) cfb_pilot_start(&estimate);
    started = 1;
    cfb_pilot_command(&estimate, last);
  }
  static const float low[4] = CFB_LOW, high[4] = CFB_HIGH;
  for (int i = 0; i < 4; i++) command[i] = fault == CFB_STOPPED ? 0.0f : low[i] + (high[i] - low[i]) * last[i];
}
