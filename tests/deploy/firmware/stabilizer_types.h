/* Of the firmware's types what the app uses, and no more: names, units and orders are the firmware's. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

#define RATE_MAIN_LOOP 1000
#define ATTITUDE_RATE 500
#define RATE_DO_EXECUTE(rate, step) (((step) % (RATE_MAIN_LOOP / (rate))) == 0)
#define M2T(milliseconds) (milliseconds)

typedef uint32_t stabilizerStep_t;
typedef struct { float x, y, z; } vector_t;
typedef struct { float roll, pitch, yaw; } attitude_t; /* deg, pitch positive with the nose up */

typedef struct {
  struct { float x, y, z, w; } attitudeQuaternion;
  vector_t position, velocity;
} state_t;

typedef struct { vector_t gyro; /* deg/s */ } sensorData_t;

typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
  vector_t position;
  struct { stab_mode_t x, y, z, roll, pitch, yaw, quat; } mode;
  vector_t velocity, acceleration;
  attitude_t attitude, attitudeRate;
  float thrust;
  bool velocity_body;
} setpoint_t;

typedef enum { controlModeLegacy = 0, controlModeForceTorque = 1, controlModeForce = 2 } control_mode_t;
typedef struct {
  union {
    struct {
      int16_t roll, pitch, yaw;
      float thrust;
    };
    float normalizedForces[4]; /* 0 to 1 */
  };
  control_mode_t controlMode;
} control_t;

void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *, const setpoint_t *, const sensorData_t *, const state_t *, const stabilizerStep_t);
