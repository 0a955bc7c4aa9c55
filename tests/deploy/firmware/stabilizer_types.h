/* Of the firmware's types what the app uses, and no more: names, units and orders are the firmware's. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

#define RATE_MAIN_LOOP 1000
#define M2T(milliseconds) (milliseconds)

typedef uint32_t stabilizerStep_t;
typedef struct { float x, y, z; } vector_t;

typedef struct {
  struct { float x, y, z, w; } attitudeQuaternion;
  vector_t position, velocity;
} state_t;

typedef struct { vector_t gyro; /* deg/s */ } sensorData_t;

typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
  vector_t position;
  struct { stab_mode_t x, y, z; } mode;
} setpoint_t;

typedef enum { controlModeLegacy = 0, controlModeForceTorque = 1, controlModeForce = 2 } control_mode_t;
typedef struct {
  float normalizedForces[4];
  control_mode_t controlMode;
} control_t;

void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *, const setpoint_t *, const sensorData_t *, const state_t *, const stabilizerStep_t);
