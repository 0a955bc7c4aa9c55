/* The policy as an out-of-tree controller of the Crazyflie firmware. @COMMANDS@
 *
 * Select it with the firmware's parameter stabilizer.controller (ControllerTypeOot), on the ground. It flies to the
 * set-point's position, wherever that comes from, and stops the motors when there is none. See README.md before flying.
 */
#include <stdbool.h>
#include <stdint.h>
//@through_pid
#include <string.h>
//@end

#include "app.h"
#include "FreeRTOS.h"
#include "task.h"

#include "controller.h"
//@loop
#include "controller_pid.h"
//@end
//@body_rates
#include "attitude_controller.h"
//@end
#include "log.h"
//@loadable
#include "mem.h"
//@end
#include "param.h"
#include "stabilizer_types.h"

#include "cfb_policy.h"
//@loadable
#include "cfb_weights.h"
//@end

#define RADIANS 0.01745329252f
//@loop
#define DEGREES 57.29577951f
#define COUNTS 65535.0f
//@end

static uint32_t period, latest;
static bool running;
static float command[4];
static uint8_t faultNow;
//@loadable
static uint8_t weightsLoaded, weightsStatus;
static uint32_t weightsCrc = CFB_SET_CRC;
//@end
//@flip
static uint8_t flip, phaseNow;
static float flipSpeed = CFB_FLIP_SPEED_MPS, flipRate = CFB_FLIP_RATE_RADPS;
//@end

//@motors
static void follow(control_t *control) {
  control->controlMode = controlModeForce;
  for (int motor = 0; motor < 4; motor++) control->normalizedForces[motor] = command[motor];
}

//@end
//@body_rates
/* The firmware's rate loop alone, at its 500 Hz; its pitch is positive with the nose up. */
static void follow(control_t *control, const sensorData_t *sensors, const stabilizerStep_t step) {
  control->controlMode = controlModeLegacy;
  if (RATE_DO_EXECUTE(ATTITUDE_RATE, step)) {
    attitudeControllerCorrectRatePID(sensors->gyro.x, -sensors->gyro.y, sensors->gyro.z, command[1] * DEGREES,
                                     -command[2] * DEGREES, command[3] * DEGREES);
    attitudeControllerGetActuatorOutput(&control->roll, &control->pitch, &control->yaw);
    control->yaw = (int16_t)-control->yaw;
  }
  control->thrust = command[0] * COUNTS;
}

//@end
//@attitude
static void fill(setpoint_t *wanted, const setpoint_t *given) {
  (void)given;
  wanted->mode.roll = wanted->mode.pitch = wanted->mode.yaw = modeAbs;
  wanted->thrust = command[0] * COUNTS;
  wanted->attitude.roll = command[1] * DEGREES;
  wanted->attitude.pitch = -command[2] * DEGREES;
  wanted->attitude.yaw = command[3] * DEGREES;
}

//@end
//@velocity
static void fill(setpoint_t *wanted, const setpoint_t *given) {
  (void)given;
  wanted->mode.x = wanted->mode.y = wanted->mode.z = modeVelocity;
  wanted->mode.yaw = modeAbs;
  wanted->velocity.x = command[0];
  wanted->velocity.y = command[1];
  wanted->velocity.z = command[2];
  wanted->attitude.yaw = command[3] * DEGREES;
}

//@end
//@position
static void fill(setpoint_t *wanted, const setpoint_t *given) {
  wanted->mode.x = wanted->mode.y = wanted->mode.z = modeAbs;
  wanted->mode.yaw = modeAbs;
  wanted->position.x = given->position.x + command[0];
  wanted->position.y = given->position.y + command[1];
  wanted->position.z = given->position.z + command[2];
  wanted->attitude.yaw = command[3] * DEGREES;
}

//@end
//@through_pid
static void follow(control_t *control, const setpoint_t *given, const sensorData_t *sensors, const state_t *state,
                   const stabilizerStep_t step) {
  setpoint_t wanted;
  memset(&wanted, 0, sizeof wanted);
  fill(&wanted, given);
  controllerPid(control, &wanted, sensors, state, step);
}

//@end
static void stop(control_t *control) {
  control->controlMode = controlModeForce;
  for (int motor = 0; motor < 4; motor++) control->normalizedForces[motor] = 0.0f;
}

//@loadable
static uint32_t weightsSize(const uint8_t id) {
  (void)id;
  return sizeof(cfb_weights_t) + 1;
}

/* Called by the firmware's memory task: the set, and behind it one byte whose writing makes the set fly. */
static bool weightsWrite(const uint8_t id, const uint32_t address, const uint8_t length, const uint8_t *bytes) {
  (void)id;
  const bool apply = address == sizeof(cfb_weights_t);
  /* Slow, and flies nothing: the controller may interrupt it. */
  if (apply) cfb_weights_check();
  /* Whether it flies and which set it would fly, as one: afterwards, a flight that begins flies a set that is whole. */
  taskENTER_CRITICAL();
  const bool still = !running;
  if (still && apply) cfb_weights_apply();
  if (still && !apply) cfb_weights_unload();
  taskEXIT_CRITICAL();
  const bool done = still && (apply ? cfb_weights_loaded() : cfb_weights_write(address, bytes, length));
  weightsLoaded = (uint8_t)cfb_weights_loaded();
  weightsStatus = (uint8_t)cfb_weights_status();
  weightsCrc = cfb_weights_crc();
  return done;
}

static const MemoryHandlerDef_t weightsMemory = {.type = MEM_TYPE_APP, .getSize = weightsSize, .write = weightsWrite};

//@end
void appMain(void) {
  for (;;) vTaskDelay(M2T(2000));
}

void controllerOutOfTreeInit(void) {
  period = (uint32_t)(cfb_policy_dt() * RATE_MAIN_LOOP + 0.5f);
  running = false;
  cfb_policy_reset();
//@loop
  controllerPidInit();
//@end
//@loadable
  /* Once: it is called again whenever this controller is selected, when the firmware takes no more memories. */
  static bool registered;
  if (!registered) memoryRegisterHandler(&weightsMemory);
  registered = true;
//@end
}

bool controllerOutOfTreeTest(void) { return period > 0; }

/* One step of the policy. */
static void plan(const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state) {
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
//@previews
  /* What is known of the path: the target's velocity and acceleration. */
  float ahead[3 * CFB_POLICY_PREVIEWS];
  for (int i = 0; i < CFB_POLICY_PREVIEWS; i++) {
    const float t = cfb_policy_preview_time(i), half = 0.5f * t * t;
    ahead[3 * i] = setpoint->velocity.x * t + setpoint->acceleration.x * half;
    ahead[3 * i + 1] = setpoint->velocity.y * t + setpoint->acceleration.y * half;
    ahead[3 * i + 2] = setpoint->velocity.z * t + setpoint->acceleration.z * half;
  }
  cfb_policy_set_preview(ahead);
//@end
  cfb_policy_step(position, velocity, quaternion_wxyz, body_rate, target, command);
  faultNow = (uint8_t)cfb_policy_fault();
//@flip
  phaseNow = (uint8_t)cfb_policy_phase();
//@end
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t stabilizerStep) {
  const bool wanted =
      setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;
  const uint32_t since = stabilizerStep - latest;

  if (!wanted) {
    running = false;
    stop(control);
    return;
  }
  /* First step, or steps were missed: what the policy remembers is not what has just happened. */
  if (!running || since > 2 * period) {
    cfb_policy_reset();
    running = true;
    latest = stabilizerStep - period;
  }
  if (stabilizerStep - latest >= period) {
    latest = stabilizerStep;
    plan(setpoint, sensors, state);
  }
  if (faultNow == CFB_STOPPED) {
    stop(control);
    return;
  }
//@motors
  follow(control);
//@end
//@body_rates
  follow(control, sensors, stabilizerStep);
//@end
//@through_pid
  follow(control, setpoint, sensors, state, stabilizerStep);
//@end
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
//@motors
/** Commands of M1..M4, 0 to 1. */
LOG_ADD(LOG_FLOAT, u1, &command[0])
LOG_ADD(LOG_FLOAT, u2, &command[1])
LOG_ADD(LOG_FLOAT, u3, &command[2])
LOG_ADD(LOG_FLOAT, u4, &command[3])
//@end
//@loop
/** Set-points of the policy, in the units of cfb_policy.h; the motors are in the firmware's group motor. */
LOG_ADD(LOG_FLOAT, set1, &command[0])
LOG_ADD(LOG_FLOAT, set2, &command[1])
LOG_ADD(LOG_FLOAT, set3, &command[2])
LOG_ADD(LOG_FLOAT, set4, &command[3])
//@end
/** 0: fine, 1: blind, 2: stopped. */
LOG_ADD(LOG_UINT8, fault, &faultNow)
//@loadable
/** Weights that fly, 0: those in flash, 1: those that were loaded; and their CRC. */
LOG_ADD(LOG_UINT8, loaded, &weightsLoaded)
LOG_ADD(LOG_UINT32, crc, &weightsCrc)
/** What became of the set that was written: cfb_weights_status_t. */
LOG_ADD(LOG_UINT8, weights, &weightsStatus)
//@end
//@flip
/** 0: hold, 1: climb, 2: turn, 3: catch. */
LOG_ADD(LOG_UINT8, phase, &phaseNow)
//@end
LOG_GROUP_STOP(cfb)
