static inline void vTaskDelay(int ticks) { (void)ticks; }
#define taskENTER_CRITICAL() ((void)0)
#define taskEXIT_CRITICAL() ((void)0)
