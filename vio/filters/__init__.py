"""Back ends: estimators fed with motion samples and observations. None of them imports cv2 or torch."""
