/* Hold the target; on cfb_policy_set_flip climb, turn about the body's x axis, and be caught where the target is.
 *
 * The same target policy holds, climbs and catches; between climb and catch a flip policy keeps rate and speed. What
 * each of them remembers is kept up to date in all phases. See cfb_pilot.h.
 */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "cfb_data.h"
#include "cfb_pilot.h"
#include "cfb_policy.h"

#define PI 3.14159265f

static const float hover[4] = CFB_HOVER_OUTPUTS;
static cfb_memory_t climb, turn, hold;
static cfb_phase_t phase;
static int asked;         /* a flip begins with the next step */
static int count;         /* commands given in this phase */
static float roll;        /* of the last estimate, rad */
static float turned;      /* since the turn began, rad */
static float setpoint[2]; /* speed along the body's z axis, m/s; rate about its x axis, rad/s */

static cfb_estimate_t raised(const cfb_estimate_t *estimate) {
  cfb_estimate_t above = *estimate;
  above.position[2] -= CFB_CLIMB_M;
  return above;
}

/* Direction of the body's z axis in the world's YZ plane. */
static float roll_angle(const float q[4]) {
  return atan2f(2.0f * (q[0] * q[1] - q[2] * q[3]), 1.0f - 2.0f * (q[1] * q[1] + q[2] * q[2]));
}

void cfb_pilot_reset(void) {
  phase = CFB_HOLD;
  asked = 0;
}

void cfb_pilot_start(const cfb_estimate_t *estimate) {
  const cfb_estimate_t above = raised(estimate);
  cfb_network_start(&cfb_holder, &climb, &above, hover);
  cfb_network_start(&cfb_turner, &turn, estimate, hover);
  cfb_network_start(&cfb_holder, &hold, estimate, hover);
  roll = roll_angle(estimate->quaternion);
  turned = 0.0f;
  count = 0;
}

void cfb_policy_set_flip(float v_target, float rate_target) {
  const int sensible = v_target >= CFB_LEAST_SPEED && v_target <= CFB_LARGEST_SPEED && rate_target >= CFB_LEAST_RATE &&
                       rate_target <= CFB_LARGEST_RATE;
  if (!sensible) return;
  setpoint[0] = v_target;
  setpoint[1] = rate_target;
  asked = phase == CFB_HOLD;
}

cfb_phase_t cfb_policy_phase(void) { return phase; }

static void advance(const cfb_estimate_t *estimate) {
  const float now = roll_angle(estimate->quaternion), change = now - roll;
  roll = now;
  turned = phase == CFB_TURN ? turned + change - 2.0f * PI * rintf(change / (2.0f * PI)) : 0.0f;
  if (asked) {
    asked = 0;
    phase = CFB_CLIMB;
    count = 0;
    memset(climb.integral, 0, sizeof climb.integral);
  }
  /* A little more, so that a time that ends with a command's own is not missed by a rounding. */
  const float elapsed = (float)count * CFB_DT_S + 1e-6f;
  int over = 0;
  if (phase == CFB_CLIMB) over = elapsed >= CFB_CLIMB_S || estimate->velocity[2] >= CFB_CLIMB_MPS;
  if (phase == CFB_TURN) over = elapsed >= CFB_TURN_S || turned >= CFB_TURN_RAD;
  if (phase == CFB_CATCH) over = elapsed >= CFB_CATCH_S;
  if (over) phase = phase == CFB_CLIMB ? CFB_TURN : (phase == CFB_TURN ? CFB_CATCH : CFB_HOLD);
  count = over ? 1 : count + 1;
  if (phase == CFB_HOLD) count = 0;
}

void cfb_pilot_command(const cfb_estimate_t *estimate, float command[4]) {
  const cfb_estimate_t above = raised(estimate);
  advance(estimate);
  if (phase == CFB_TURN)
    cfb_network_command(&cfb_turner, &turn, estimate, setpoint, command);
  else if (phase == CFB_CLIMB)
    cfb_network_command(&cfb_holder, &climb, &above, NULL, command);
  else
    cfb_network_command(&cfb_holder, &hold, estimate, NULL, command);
  cfb_network_remember(&cfb_holder, &climb, &above, command);
  cfb_network_remember(&cfb_turner, &turn, estimate, command);
  cfb_network_remember(&cfb_holder, &hold, estimate, command);
  /* An integral gathered while climbing and turning says nothing about what holding needs. */
  if (phase == CFB_CLIMB || phase == CFB_TURN) memset(hold.integral, 0, sizeof hold.integral);
}
