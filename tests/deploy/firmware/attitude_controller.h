/* The firmware's rate loop, which here keeps what it was asked for. */
#pragma once
#include "stabilizer_types.h"

float asked[6];
void attitudeControllerCorrectRatePID(float roll, float pitch, float yaw, float rollWanted, float pitchWanted,
                                      float yawWanted);
void attitudeControllerGetActuatorOutput(int16_t *roll, int16_t *pitch, int16_t *yaw);

#ifndef FIRMWARE_ELSEWHERE
void attitudeControllerCorrectRatePID(float roll, float pitch, float yaw, float rollWanted, float pitchWanted,
                                      float yawWanted) {
  const float given[6] = {roll, pitch, yaw, rollWanted, pitchWanted, yawWanted};
  for (int i = 0; i < 6; i++) asked[i] = given[i];
}

void attitudeControllerGetActuatorOutput(int16_t *roll, int16_t *pitch, int16_t *yaw) {
  *roll = 100;
  *pitch = 200;
  *yaw = 300;
}
#endif
