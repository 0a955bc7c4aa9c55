static inline void vTaskDelay(int ticks) { (void)ticks; }
