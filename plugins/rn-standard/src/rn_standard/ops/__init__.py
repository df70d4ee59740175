"""Operations: incident records, restarts, memory limits, logs and the doctor."""
