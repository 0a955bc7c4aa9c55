/* A trained policy of a Crazyflie Brushless: state estimate in, commands out.
 *
 * Exported by cfb_mjx; what every number means is in contract.json, how to fly it in README.md. C11, single precision,
 * static memory only; not reentrant. Do not compile it with -ffast-math.
 */
#ifndef CFB_POLICY_H
#define CFB_POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

/* Forget everything: the next step begins anew, and faults are over. */
void cfb_policy_reset(void);

/* One step; call it every cfb_policy_dt() seconds.
 *
 * position, target: world, m. velocity: world, m/s. quaternion_wxyz: body to world; its norm does not matter.
 * body_rate: body axes (x forward, y left, z up), rad/s. command:
@OUTPUTS@
 *
 * A step on an estimate that cannot be (not finite, or beyond 1e6; a quaternion of norm zero) does not enter the
 * history: it repeats the last command. After CFB_POLICY_BLIND_STEPS of them in a row, or when there is no last
 * command, the motors are to be stopped (CFB_STOPPED; the command is 0 then), until cfb_policy_reset(). The same holds
 * for an estimate that is frozen: it says that the drone moves, and is the same, bit for bit, after
 * CFB_POLICY_FROZEN_STEPS more steps.
 */
void cfb_policy_step(const float position[3], const float velocity[3], const float quaternion_wxyz[4],
                     const float body_rate[3], const float target[3], float command[4]);

/* Time between two steps, s. */
float cfb_policy_dt(void);

#define CFB_POLICY_BLIND_STEPS @BLIND_STEPS@
#define CFB_POLICY_FROZEN_STEPS @FROZEN_STEPS@

typedef enum {
  CFB_FINE,    /* the last step was a normal one */
  CFB_BLIND,   /* it repeated the command before, for want of an estimate */
  CFB_STOPPED, /* the motors are to be stopped until cfb_policy_reset() */
} cfb_fault_t;

cfb_fault_t cfb_policy_fault(void);

//@previews
/* What the policy sees of the path ahead: where the target will be @PREVIEWS_S@ s from now, relative to where it is
 * now, world, m. Set it before every step; without it the target is taken to stand still.
 */
#define CFB_POLICY_PREVIEWS @PREVIEWS@
void cfb_policy_set_preview(const float ahead[3 * CFB_POLICY_PREVIEWS]);
/* Time until the target is at preview number i, from 0, s. */
float cfb_policy_preview_time(int i);

//@end
//@flip
#define CFB_POLICY_FLIPS 1

/* What the manoeuvre is doing. */
typedef enum {
  CFB_HOLD,  /* holding the target */
  CFB_CLIMB, /* gathering speed towards a target above */
  CFB_TURN,  /* keeping rate and speed */
  CFB_CATCH, /* back to the target; CFB_HOLD after that */
} cfb_phase_t;

/* Flip: from holding the target, climb, turn and be caught there, beginning with the next step.
 *
 * v_target: speed along the body's z axis while turning, m/s. rate_target: rate about its x axis, rad/s. Those that the
 * manoeuvre was designed with are CFB_FLIP_SPEED_MPS and CFB_FLIP_RATE_RADPS. While a flip is under way only the two
 * numbers change. Does nothing when they lie outside of what the policy was trained for.
 */
void cfb_policy_set_flip(float v_target, float rate_target);

#define CFB_FLIP_SPEED_MPS @SPEED@
#define CFB_FLIP_RATE_RADPS @RATE@

cfb_phase_t cfb_policy_phase(void);

//@end
#ifdef __cplusplus
}
#endif

#endif
