/* The policy as an out-of-tree controller of the Crazyflie firmware, commanding the motors directly.
 *
 * Select it with the firmware's parameter stabilizer.controller (ControllerTypeOot), on the ground. It flies to the
 * set-point's position, wherever that comes from, and stops the motors when there is none. See README.md before flying.
 */
#include <stdbool.h>
#include <stdint.h>

#include "app.h"
#include "FreeRTOS.h"
#include "task.h"

#include "controller.h"
#include "log.h"
#include "param.h"
#include "stabilizer_types.h"

#include "cfb_policy.h"

#define RADIANS 0.01745329252f

static uint32_t period, latest;
static bool running;
static float command[4];
static uint8_t faultNow;
//@flip
static uint8_t flip, phaseNow;
static float flipSpeed = CFB_FLIP_SPEED_MPS, flipRate = CFB_FLIP_RATE_RADPS;
//@end

void appMain(void) {
  for (;;) vTaskDelay(M2T(2000));
}

void controllerOutOfTreeInit(void) {
  period = (uint32_t)(cfb_policy_dt() * RATE_MAIN_LOOP + 0.5f);
  running = false;
  cfb_policy_reset();
}

bool controllerOutOfTreeTest(void) { return period > 0; }

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t stabilizerStep) {
  const bool wanted =
      setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;
  const uint32_t since = stabilizerStep - latest;

  control->controlMode = controlModeForce;
  if (!wanted) {
    running = false;
    for (int motor = 0; motor < 4; motor++) control->normalizedForces[motor] = 0.0f;
    return;
  }
  /* First step, or steps were missed: what the policy remembers is not what has just happened. */
  if (!running || since > 2 * period) {
    cfb_policy_reset();
    running = true;
  } else if (since < period) {
    for (int motor = 0; motor < 4; motor++) control->normalizedForces[motor] = command[motor];
    return;
  }
  latest = stabilizerStep;

//@flip
  if (flip) {
    flip = 0;
    cfb_policy_set_flip(flipSpeed, flipRate);
  }
//@end
  const float position[3] = {state->position.x, state->position.y, state->position.z};
  const float velocity[3] = {state->velocity.x, state->velocity.y, state->velocity.z};
  const float quaternion_wxyz[4] = {state->attitudeQuaternion.w, state->attitudeQuaternion.x,
                                    state->attitudeQuaternion.y, state->attitudeQuaternion.z};
  const float body_rate[3] = {sensors->gyro.x * RADIANS, sensors->gyro.y * RADIANS, sensors->gyro.z * RADIANS};
  const float target[3] = {setpoint->position.x, setpoint->position.y, setpoint->position.z};
  cfb_policy_step(position, velocity, quaternion_wxyz, body_rate, target, command);
  faultNow = (uint8_t)cfb_policy_fault();
//@flip
  phaseNow = (uint8_t)cfb_policy_phase();
//@end
  for (int motor = 0; motor < 4; motor++) control->normalizedForces[motor] = command[motor];
}

//@flip
PARAM_GROUP_START(cfbflip)
/** Set to 1 to flip; goes back to 0 by itself. */
PARAM_ADD(PARAM_UINT8, go, &flip)
/** Speed along the body's z axis while turning, m/s. */
PARAM_ADD(PARAM_FLOAT, speed, &flipSpeed)
/** Rate about the body's x axis while turning, rad/s. */
PARAM_ADD(PARAM_FLOAT, rate, &flipRate)
PARAM_GROUP_STOP(cfbflip)

//@end
LOG_GROUP_START(cfb)
/** Commands of M1..M4, 0 to 1. */
LOG_ADD(LOG_FLOAT, u1, &command[0])
LOG_ADD(LOG_FLOAT, u2, &command[1])
LOG_ADD(LOG_FLOAT, u3, &command[2])
LOG_ADD(LOG_FLOAT, u4, &command[3])
/** 0: fine, 1: blind, 2: stopped. */
LOG_ADD(LOG_UINT8, fault, &faultNow)
//@flip
/** 0: hold, 1: climb, 2: turn, 3: catch. */
LOG_ADD(LOG_UINT8, phase, &phaseNow)
//@end
LOG_GROUP_STOP(cfb)
