base_color = (1.0, 0.766, 0.336, 1.0)
color_amount = 1.0
metallic = 1.0
metallic_amount = 1.0
roughness = 0.15
roughness_amount = 1.0
