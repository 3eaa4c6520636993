"""The plate decoder beside the PolyU paper and beside cv2.aruco, on simulated frames."""
