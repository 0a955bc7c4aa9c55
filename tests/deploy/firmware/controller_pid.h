/* The firmware's PID, which here keeps the set-point that it was given. */
#pragma once
#include "stabilizer_types.h"

setpoint_t followed;
void controllerPidInit(void);
void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                   const stabilizerStep_t step);

#ifndef FIRMWARE_ELSEWHERE
void controllerPidInit(void) {}

void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                   const stabilizerStep_t step) {
  (void)sensors, (void)state, (void)step;
  followed = *setpoint;
  control->controlMode = controlModeLegacy;
}
#endif
